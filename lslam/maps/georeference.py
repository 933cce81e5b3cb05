"""From a run's world to coordinates every GIS knows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import UsageError
from lslam.geometry import se3
from lslam.geometry.geodesy import from_local, local_crs
from lslam.types.cloud import Cloud, CloudBlock
from lslam.types.gnss import Georeference
from lslam.untrusted import whole_number

Floats = NDArray[np.float64]


def utm_epsg(lat: float, lon: float) -> int:
    """EPSG code of the UTM zone of a place, deg, WGS84; the exceptions of Norway and Svalbard are not made.

    >>> utm_epsg(49.0, 8.4), utm_epsg(-33.9, 18.4)
    (32632, 32734)
    """
    zone = int((lon + 180) // 6) % 60 + 1
    return (32700 if lat < 0 else 32600) + zone


@dataclass(frozen=True)
class Projection:
    """Carries a run's world into a projected coordinate reference system: that of the georeference, else the UTM zone.

    Heights are those above the WGS84 ellipsoid, m.
    """

    georeference: Georeference

    @property
    def epsg(self) -> int:
        """Code of the coordinate reference system."""
        lat, lon, _ = (float(v) for v in self.georeference.origin)
        return self.georeference.epsg or utm_epsg(lat, lon)

    @property
    def wkt(self) -> str:
        """Its definition as WKT 1, what LAS asks for."""
        return str(self._crs.to_wkt("WKT1_GDAL") or self._crs.to_wkt())

    def apply(self, points: NDArray[Any]) -> Floats:
        """Points (N, 3) of the run's world, m, to (N, 3) easting, northing, height, m."""
        enu = se3.apply(self.georeference.T_enu_world, np.asarray(points, np.float64).reshape(-1, 3))
        x, y = self._transformer.transform(enu[:, 0], enu[:, 1])
        return np.column_stack([x, y, enu[:, 2] + float(self.georeference.origin[2])])

    def invert(self, points: NDArray[Any]) -> Floats:
        """The inverse of `apply`: easting, northing, height, m, to the run's world, m."""
        from pyproj.enums import TransformDirection

        there = np.asarray(points, np.float64).reshape(-1, 3)
        x, y = self._transformer.transform(there[:, 0], there[:, 1], direction=TransformDirection.INVERSE)
        enu = np.column_stack([x, y, there[:, 2] - float(self.georeference.origin[2])])
        return se3.apply(se3.inverse(self.georeference.T_enu_world), enu)

    def check(self) -> None:
        """Raise UsageError unless the coordinate reference system is known and counts in metres."""
        units = {axis.unit_name for axis in self._crs.axis_info[:2]}
        if not self._crs.is_projected or units != {"metre"}:
            raise UsageError(
                f"--crs EPSG:{self.epsg} ({self._crs.name}) does not count in metres on a plane: choose a projected "
                f"one, for example EPSG:{Projection(_without_epsg(self.georeference)).epsg}"
            )

    @cached_property
    def _crs(self) -> Any:
        from pyproj import CRS
        from pyproj.exceptions import CRSError

        try:
            return CRS.from_epsg(self.epsg)
        except CRSError:
            raise UsageError(f"--crs EPSG:{self.epsg}: PROJ knows no such coordinate reference system") from None

    @cached_property
    def _transformer(self) -> Any:
        from pyproj import Transformer

        return Transformer.from_crs(local_crs(self.georeference.origin), self._crs, always_xy=True)


@dataclass(frozen=True)
class ProjectedCloud:
    """A cloud of a run's world in projected coordinates; satisfies `Cloud`."""

    cloud: Cloud
    projection: Projection

    @property
    def has_intensity(self) -> bool:
        """As the cloud."""
        return self.cloud.has_intensity

    def __len__(self) -> int:
        return len(self.cloud)

    def blocks(self) -> Iterator[CloudBlock]:
        """The blocks of the cloud, projected."""
        for block in self.cloud.blocks():
            yield CloudBlock(self.projection.apply(block.points), block.intensity)


def to_lat_lon(points: NDArray[Any], georeference: Georeference) -> Floats:
    """Points (N, 3) of the run's world, m, to (N, 3) lat, lon (deg), height (m), WGS84."""
    return from_local(se3.apply(georeference.T_enu_world, points), georeference.origin)


def to_wgs84(points: NDArray[Any], epsg: int) -> Floats:
    """Points (N, 3) in the coordinates `epsg`, x (or longitude, deg) first, to (N, 3) lat, lon (deg), height (m), WGS84.

    Heights are those of the coordinates where these have some, else above the ellipsoid. Raises UsageError for a code that PROJ
    does not know, and for what is no place in it.
    """
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError

    there = np.asarray(points, np.float64).reshape(-1, 3)
    try:
        crs = CRS.from_epsg(epsg)
        transformer = Transformer.from_crs(crs if len(crs.axis_info) > 2 else crs.to_3d(), "EPSG:4979", always_xy=True)
    except CRSError:
        raise UsageError(f"EPSG:{epsg}: PROJ knows no such coordinate reference system") from None
    lon, lat, height = transformer.transform(there[:, 0], there[:, 1], there[:, 2])
    out = np.column_stack([lat, lon, height])
    wrong = np.flatnonzero(~(np.isfinite(out).all(1) & (np.abs(out[:, 0]) <= 90) & (np.abs(out[:, 1]) <= 360)))
    if len(wrong):
        x, y, _ = there[wrong[0]]
        raise UsageError(f"{x:.1f}, {y:.1f} is no place in EPSG:{epsg} ({crs.name}): easting or longitude comes first")
    return out


def parse_crs(text: str) -> int:
    """The code of `EPSG:25832`; raises UsageError on anything else."""
    name, _, digits = text.strip().partition(":")
    number = whole_number(digits)
    if name.upper() != "EPSG" or number is None:
        raise UsageError(f"--crs {text}: expected EPSG and a number, for example EPSG:25832")
    return number


def _without_epsg(georeference: Georeference) -> Georeference:
    return Georeference(georeference.origin, georeference.T_enu_world)
