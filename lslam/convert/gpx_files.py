"""GPX 1.1, what receivers and map programs open: the way of a trajectory as a track, by gpxpy."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from lslam.convert.kml_files import Place
from lslam.extras import importing, install_hint
from lslam.formats.atomic import write_text
from lslam.version import __version__


def write_gpx(path: Path, places: Sequence[Place], times: Sequence[datetime] | None, name: str, about: str) -> None:
    """Write a way of lat, lon (deg), height (m), WGS84, as one segment, with `times` (UTC) where they are known.

    Raises OutputError when the file cannot be written, InputError without gpxpy.
    """
    with importing("gpxpy", install_hint("geo")):
        from gpxpy.gpx import GPX, GPXTrack, GPXTrackPoint, GPXTrackSegment
    points = [
        GPXTrackPoint(lat, lon, elevation=height, time=None if times is None else times[k])
        for k, (lat, lon, height) in enumerate(places)
    ]
    document = GPX()
    document.creator = f"lslam {__version__}"
    track = GPXTrack(name=name, description=about)
    track.segments.append(GPXTrackSegment(points))
    document.tracks.append(track)
    write_text(path, document.to_xml(version="1.1") + "\n")
