"""Prior map for localisation, read from the output of an earlier run or another program."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from lslam.backend.localization.prior_map import PriorMap, make_prior_map
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.errors import ConfigError, InputError, UsageError
from lslam.core.types.arrays import Floats
from lslam.core.types.cloud import ArrayCloud
from lslam.io.formats.point_files import MAP_SUFFIXES, SUFFIXES, read_cloud
from lslam.maps.georeference import Projection
from lslam.pipeline.map_files import georeference_of, in_own_world, note_of, read_json
from lslam.pipeline.map_tiles import INDEX, is_tiles, read_tiles
from lslam.pipeline.merge_runs import read_session
from lslam.pipeline.rebuild import map_of
from lslam.pipeline.run_folder import require_run
from lslam.registration.preprocessing.ground import Z

log = logging.getLogger("lslam")
# m; coordinates beyond are those of a projection, which a trajectory in float32 plots and maps would lose centimetres of.
LARGE, KILOMETRE = 1e5, 1000.0


def require_map(target: Path, needs_place: bool = False) -> Path:
    """Cloud file of a map, or its folder of tiles, without reading it. Raises InputError when there is none.

    needs_place : satellite fixes are to lead into it. Raises UsageError when nobody knows where it lies on the Earth.
    """
    path = _cloud_file(target)
    about = read_json(path / INDEX) if is_tiles(path) else note_of(path)
    if needs_place and georeference_of(about.get("georeference")) is None:
        raise UsageError(f"--gnss: {path} is not georeferenced; say where the drive begins with --start X,Y,HEADING")
    return path


def _cloud_file(target: Path) -> Path:
    if is_tiles(target):
        return target
    if target.is_dir():
        require_run(target)
        return map_of(target)
    if not target.exists():
        raise InputError(f"the map {target} does not exist")
    if target.suffix.lower() not in (*MAP_SUFFIXES, *SUFFIXES):
        raise InputError(
            f"the map {target} is no run folder and no cloud: known suffixes are {', '.join(MAP_SUFFIXES)}"
        )
    return target


def read_prior_map(target: Path, config: RegistrationConfig) -> PriorMap:
    """Read the map, in coordinates near it: those of the run, or of the file less whole kilometres.

    Raises InputError naming what is missing or broken.
    """
    path = require_map(target)
    if is_tiles(path):
        cloud, index = read_tiles(path)
        georeference = georeference_of(index.get("georeference"))
        if index.get("crs") is not None and georeference is not None:
            cloud = ArrayCloud(Projection(georeference).invert(cloud.points))
    else:
        cloud, georeference = in_own_world(path, read_cloud(path))
    points, origin = cloud.points, np.zeros(3)
    if len(points) and float(np.abs(points).max()) > LARGE:
        origin = np.round(np.nanmedian(points, axis=0) / KILOMETRE) * KILOMETRE
        log.info("coordinates of %s are large: the world of this run begins at %s of them", path, origin.tolist())
    return make_prior_map(points, config, georeference, str(path), origin, _up_of(path.parent))


def _up_of(folder: Path) -> Floats:
    """(3,) up in the world of the run in a folder, by the mounting of its sensor; z by default."""
    try:
        return read_session(folder, folder.name)[1].up
    except (InputError, ConfigError):
        return Z
