"""GeoJSON (RFC 7946), what web maps and GIS draw."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.formats.atomic import atomic_write


def write_line(path: Path, lat_lon_alt: NDArray[Any], properties: Mapping[str, Any]) -> None:
    """Write a way (N, 3) of lat, lon (deg), height (m), WGS84, as one feature, a point where N is 1; atomically.

    Degrees have 7 decimals (1 cm), heights 3. Raises OutputError when the file cannot be written.
    """
    places = [
        [round(float(lon), 7), round(float(lat), 7), round(float(height), 3)]
        for lat, lon, height in np.asarray(lat_lon_alt, np.float64).reshape(-1, 3)
        if np.isfinite([lat, lon, height]).all()
    ]
    geometry: dict[str, Any] | None = {"type": "LineString", "coordinates": places}
    if len(places) < 2:
        geometry = {"type": "Point", "coordinates": places[0]} if places else None
    feature = {"type": "Feature", "properties": dict(properties), "geometry": geometry}
    text = json.dumps({"type": "FeatureCollection", "features": [feature]}, allow_nan=False, ensure_ascii=False)
    with atomic_write(path) as stream:
        stream.write(text.encode() + b"\n")
