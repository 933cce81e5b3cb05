"""What of a run folder a viewer shows."""

from __future__ import annotations

import logging
from pathlib import Path

from lslam.errors import InputError
from lslam.formats.point_files import read_cloud
from lslam.formats.trajectory_files import read_trajectory
from lslam.maps.georeference import Projection
from lslam.pipeline.map_files import georeference_of, note_of
from lslam.pipeline.rebuild import map_of, read_run
from lslam.reports.recording import ViewedRun
from lslam.types.cloud import ArrayCloud

log = logging.getLogger("lslam")


def viewed_run(folder: Path) -> ViewedRun:
    """Trajectory, odometry where there was a back end, and the map, all in the run's world.

    Raises InputError naming what is missing or broken; a run without a map is shown without one.
    """
    run = read_run(folder)
    odometry = None
    if (folder / "trajectory_odometry.tum").is_file():
        odometry = read_trajectory(folder / "trajectory_odometry.tum", "tum")
    name = str(run.manifest.get("sequence", {}).get("name", folder.name))
    return ViewedRun(f"{name} ({folder.name})", run.trajectory, _cloud(folder), odometry)


def _cloud(folder: Path) -> ArrayCloud | None:
    """The run's map; LAS of a georeferenced run comes back from its coordinates."""
    try:
        path = map_of(folder)
    except InputError as error:
        log.warning("%s", error)
        return None
    cloud = read_cloud(path)
    about = note_of(path)
    georeference = georeference_of(about.get("georeference"))
    if about.get("crs") is None or georeference is None:
        return cloud
    return ArrayCloud(Projection(georeference).invert(cloud.points), cloud.intensity)
