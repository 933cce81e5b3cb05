"""KML 2.2, what Google Earth and QGIS open: the way of a trajectory, by fastkml."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from lslam.extras import importing, install_hint
from lslam.formats.atomic import write_text

Place = tuple[float, float, float]


def write_kml(path: Path, places: Sequence[Place], times: Sequence[datetime] | None, name: str, about: str) -> None:
    """Write a way of lat, lon (deg), height (m), WGS84, as a line, and as a track in time where `times` (UTC) are known.

    The line lies on the ground: KML counts heights from the sea, ours are above the ellipsoid. They stand in the coordinates.
    Raises OutputError when the file cannot be written, InputError without fastkml.
    """
    with importing("fastkml", install_hint("geo")), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # without lxml it does not indent
        from fastkml import KML, Document, Placemark, gx
        from fastkml.enums import AltitudeMode
        from fastkml.geometry import LineString
        from fastkml.times import KmlDateTime
        from pygeoif import geometry
    coordinates = [(lon, lat, height) for lat, lon, height in places]
    # KML asks for two points of a line.
    line = geometry.LineString(coordinates if len(coordinates) > 1 else coordinates * 2)
    marks = [Placemark(name=name, description=about, kml_geometry=LineString(
        geometry=line, tessellate=True, altitude_mode=AltitudeMode.clamp_to_ground,
    ))]  # fmt: skip
    if times is not None:
        track = gx.Track(
            altitude_mode=AltitudeMode.clamp_to_ground, whens=[KmlDateTime(t) for t in times], coords=coordinates
        )
        marks.append(Placemark(name=f"{name}, in time", kml_geometry=track))
    document = KML(features=[Document(name=name, description=about, features=marks)])
    write_text(path, '<?xml version="1.0" encoding="UTF-8"?>\n' + document.to_string() + "\n")
