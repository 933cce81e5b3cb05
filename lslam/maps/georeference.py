"""Coordinates of a run's world on the Earth, in coordinate reference systems of GIS."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import UsageError
from lslam.core.geometry import se3, so3
from lslam.core.geometry.crs_names import crs_name
from lslam.core.geometry.geodesy import (
    crs_of,
    exact_transformer,
    from_local,
    geoid_heights,
    has_heights,
    local_crs,
    to_local,
)
from lslam.core.types.cloud import Cloud, CloudBlock
from lslam.core.types.gnss import Georeference, OutputCrs


def utm_epsg(lat: float, lon: float) -> int:
    """EPSG code of the UTM zone of a place, deg, WGS84; the exceptions of Norway and Svalbard are not made.

    >>> utm_epsg(49.0, 8.4), utm_epsg(-33.9, 18.4)
    (32632, 32734)
    """
    zone = int((lon + 180) // 6) % 60 + 1
    return (32700 if lat < 0 else 32600) + zone


@dataclass(frozen=True)
class LocalFrame:
    """Coordinates without a georeference in place of a `Projection`: they stay unchanged; frame : the world in words."""

    frame: str

    name = plane = "local coordinates"
    epsg = None
    wkt = plane_wkt = attribution = ""
    heights = "heights above the first pose of the sensor"

    def apply(self, points: NDArray[Any]) -> Floats:
        """The points (N, 3), m, unchanged."""
        return np.asarray(points, np.float64).reshape(-1, 3)

    def carry(self, poses: NDArray[Any]) -> Floats:
        """The poses (N, 4, 4), m, unchanged."""
        return np.asarray(poses, np.float64).reshape(-1, 4, 4)


@dataclass(frozen=True)
class Projection:
    """Transforms a run's world into a projected coordinate reference system: that of the georeference, else the UTM zone.

    Heights are those of its vertical datum or of the geoid of the georeference, m; without both above the WGS84 ellipsoid.
    """

    georeference: Georeference

    @property
    def epsg(self) -> int:
        """EPSG code of the horizontal coordinate reference system."""
        lat, lon, _ = (float(v) for v in self.georeference.origin)
        return self.georeference.epsg or utm_epsg(lat, lon)

    @property
    def name(self) -> str:
        """As `EPSG:25832`, or `EPSG:25832+7837` with heights."""
        return crs_name(self.epsg, self.georeference.height_epsg)

    @property
    def frame(self) -> str:
        """Description of the coordinates."""
        geoid = self.georeference.geoid
        if geoid:
            return f"{self.name}, heights above the geoid of {Path(geoid).name}"
        if has_heights(self._crs):
            return f"{self.name}, {self._crs.sub_crs_list[1].name}"
        return f"{self.name}, heights above the WGS84 ellipsoid"

    @property
    def plane(self) -> str:
        """Name of the horizontal coordinate reference system, as `WGS 84 / UTM zone 32N`."""
        return str(self._plane.name)

    @property
    def plane_wkt(self) -> str:
        """Its definition as WKT 1."""
        return str(self._plane.to_wkt("WKT1_GDAL") or self._plane.to_wkt())

    @property
    def wkt(self) -> str:
        """Definition of the coordinate reference system as WKT 1, which LAS needs."""
        return str(self._crs.to_wkt("WKT1_GDAL") or self._crs.to_wkt())

    @property
    def wkt2(self) -> str:
        """The same as WKT 2."""
        return str(self._crs.to_wkt())

    @property
    def attribution(self) -> str:
        """Credit that a map must carry if data of others placed it on the Earth; else empty."""
        is_theirs = self.georeference.method == "osm"
        return "placed by buildings, © OpenStreetMap contributors, ODbL 1.0" if is_theirs else ""

    @property
    def operation(self) -> str:
        """Transformation from WGS 84 as PROJ describes it: its steps, stated accuracy, and grids."""
        parts = self._transformer.operations or ()
        steps = [part.name for part in parts if "unknown" not in part.name and "axis order" not in part.name]
        grids = [grid.short_name for part in parts for grid in part.grids]
        grids += [Path(self.georeference.geoid).name] if self.georeference.geoid else []
        accuracy = float(self._transformer.accuracy)
        stated = f"stated accuracy {accuracy:g} m" if accuracy >= 0 else "no stated accuracy"
        return "; ".join([*steps, stated, f"grids {', '.join(grids)}" if grids else "no grid"])

    @property
    def convergence_and_scale(self) -> tuple[float, float]:
        """Angle from true north to grid north at the origin, deg, clockwise positive, and the scale of the grid there."""
        from pyproj import Proj

        lat, lon, _ = (float(v) for v in self.georeference.origin)
        factors = Proj(self._plane).get_factors(lon, lat)
        return float(factors.meridian_convergence), float(np.sqrt(factors.areal_scale))

    @property
    def heights(self) -> str:
        """Zero level of the heights in words."""
        return self.frame.partition(", ")[2]

    def apply(self, points: NDArray[Any]) -> Floats:
        """Easting, northing, height (N, 3), m, of points (N, 3), m, world. Raises UsageError where a grid of heights ends."""
        enu = se3.apply(self.georeference.T_enu_world, np.asarray(points, np.float64).reshape(-1, 3))
        if self._is_vertical:
            places = from_local(enu, self.georeference.origin)
            out = np.column_stack(self._transformer.transform(places[:, 1], places[:, 0], places[:, 2]))
            if not np.isfinite(out).all():
                raise UsageError(f"--crs {self.name}: its grid of heights ends within the map")
            return out
        x, y = self._transformer.transform(enu[:, 0], enu[:, 1])
        heights = enu[:, 2] + float(self.georeference.origin[2])
        if self.georeference.geoid and len(enu):
            heights -= geoid_heights(self.georeference.geoid, from_local(enu, self.georeference.origin))
        return np.column_stack([x, y, heights])

    def invert(self, points: NDArray[Any]) -> Floats:
        """The inverse of `apply`: easting, northing, height, m, to the run's world, m."""
        from pyproj.enums import TransformDirection

        there = np.asarray(points, np.float64).reshape(-1, 3)
        T_world_enu = se3.inverse(self.georeference.T_enu_world)
        if self._is_vertical:
            lon, lat, height = self._transformer.transform(*there.T, direction=TransformDirection.INVERSE)
            return se3.apply(T_world_enu, to_local(np.column_stack([lat, lon, height]), self.georeference.origin))
        x, y = self._transformer.transform(there[:, 0], there[:, 1], direction=TransformDirection.INVERSE)
        enu = np.column_stack([x, y, there[:, 2] - float(self.georeference.origin[2])])
        if self.georeference.geoid and len(enu):
            enu[:, 2] += geoid_heights(self.georeference.geoid, from_local(enu, self.georeference.origin))
        return se3.apply(T_world_enu, enu)

    def carry(self, poses: NDArray[Any]) -> Floats:
        """Transform poses (N, 4, 4) of the run's world to the projected coordinates, m; rotations are those in its grid."""
        poses = np.asarray(poses, np.float64).reshape(-1, 4, 4)
        at = poses[:, :3, 3]
        # Derivatives by the axes of the world; the scale of the plane is no part of a rotation.
        steps = np.stack([(self.apply(at + axis) - self.apply(at - axis)) / 2 for axis in np.eye(3)], axis=-1)
        return se3.make(so3.normalise(steps) @ poses[:, :3, :3], self.apply(at))

    def check(self) -> None:
        """Raise UsageError unless the coordinate reference system is known, in metres and reached without loss of accuracy."""
        units = {axis.unit_name for axis in self._crs.axis_info}
        if not self._crs.is_projected or units != {"metre"} or self._crs.axis_info[-1].direction == "down":
            raise UsageError(
                f"--crs {self.name} ({self._crs.name}) does not count in metres on a plane: choose a projected "
                f"one, for example EPSG:{Projection(_without_epsg(self.georeference)).epsg}"
            )
        if self.georeference.geoid and not has_heights(self._crs) and len(self._crs.axis_info) > 2:
            raise UsageError(
                f"--geoid: heights in {self.name} count from the ellipsoid, by its name: leave out one of them"
            )
        self.apply(np.zeros((1, 3)))

    @cached_property
    def _crs(self) -> Any:
        return crs_of(self.epsg, self.georeference.height_epsg)

    @property
    def _plane(self) -> Any:
        return self._crs.sub_crs_list[0] if has_heights(self._crs) else self._crs

    @property
    def _is_vertical(self) -> bool:
        """Whether PROJ's own operation gives the heights."""
        return has_heights(self._crs) and not self.georeference.geoid

    @cached_property
    def _transformer(self) -> Any:
        """pyproj's transformer from the local frame, or WGS 84 with heights, to the projected coordinates."""
        if self._is_vertical:
            return exact_transformer("EPSG:4979", self._crs, self.georeference.origin[:2], self.name)
        return exact_transformer(
            local_crs(self.georeference.origin), self._plane, self.georeference.origin[:2], self.name
        )


@dataclass(frozen=True)
class ProjectedCloud:
    """A cloud in other coordinates, as `Projection.apply` or `invert` transform points (N, 3); satisfies `Cloud`."""

    cloud: Cloud
    transform: Callable[[NDArray[Any]], Floats]

    @property
    def has_intensity(self) -> bool:
        """Whether the cloud has intensities."""
        return self.cloud.has_intensity

    @property
    def column_types(self) -> Mapping[str, np.dtype[Any]]:
        """Types of the further columns of the cloud."""
        return self.cloud.column_types

    def __len__(self) -> int:
        return len(self.cloud)

    def blocks(self) -> Iterator[CloudBlock]:
        """The blocks of the cloud, transformed."""
        for block in self.cloud.blocks():
            yield replace(block, points=self.transform(block.points))


def in_crs(georeference: Georeference, crs: OutputCrs | None) -> Georeference:
    """Georeference whose outputs are in `crs`, None for its own. Raises UsageError for one that nothing can be written in."""
    if crs is None:
        return georeference
    if crs.epsg is not None:
        georeference = replace(georeference, epsg=crs.epsg, height_epsg=crs.height_epsg)
    georeference = replace(georeference, geoid=crs.geoid or georeference.geoid)
    Projection(georeference).check()
    return georeference


def to_lat_lon(points: NDArray[Any], georeference: Georeference) -> Floats:
    """Transform points (N, 3) of the run's world, m, to (N, 3) lat, lon (deg), height (m), WGS84."""
    return from_local(se3.apply(georeference.T_enu_world, points), georeference.origin)


def to_wgs84(points: NDArray[Any], epsg: int, height_epsg: int | None = None, geoid: str = "") -> Floats:
    """Transform points (N, 3) in `epsg`, x (or longitude, deg) first, to (N, 3) lat, lon (deg), height (m), WGS84.

    Heights are those above the grid `geoid` where there is one and the coordinates are not ellipsoidal by name, else of the
    coordinates where these have some, else above the ellipsoid. Raises UsageError for a code that PROJ does not know, for what
    is no place in it, and where the exact operation lacks a grid.
    """
    from pyproj import Transformer

    there, crs = np.asarray(points, np.float64).reshape(-1, 3), crs_of(epsg, height_epsg)
    is_compound, is_ellipsoidal = has_heights(crs), not has_heights(crs) and len(crs.axis_info) > 2
    plane = crs.sub_crs_list[0] if is_compound else crs if is_ellipsoidal else crs.to_3d()
    flat = crs.sub_crs_list[0] if is_compound else crs.to_2d()
    lon, lat = Transformer.from_crs(flat, "EPSG:4326", always_xy=True).transform(there[:, 0], there[:, 1])
    _require_places(there, np.column_stack([lat, lon, there[:, 2]]), crs, epsg)
    places, name = np.column_stack([lat, lon]), crs_name(epsg, height_epsg)
    if not is_compound or geoid:
        source = plane if not is_compound else plane.to_3d()
        out = _transform(exact_transformer(source, "EPSG:4979", places, name), there)
        if geoid and not is_ellipsoidal:
            # The plane's own ellipsoid has no say in heights above a geoid.
            out[:, 2] = there[:, 2] + geoid_heights(geoid, out)
    else:
        out = _transform(exact_transformer(crs, "EPSG:4979", places, name), there)
    _require_places(there, out, crs, epsg)
    return out


def _transform(transformer: Any, points: Floats) -> Floats:
    """Transform points (N, 3) by pyproj's transformer to (N, 3) lat, lon (deg), height (m)."""
    lon, lat, height = transformer.transform(points[:, 0], points[:, 1], points[:, 2])
    return np.column_stack([lat, lon, height])


def _require_places(points: Floats, places: Floats, crs: Any, epsg: int) -> None:
    """Raise UsageError naming the first of `points` whose `places` (N, 3) lat, lon, height are not on the Earth."""
    wrong = np.flatnonzero(~(np.isfinite(places).all(1) & (np.abs(places[:, 0]) <= 90) & (np.abs(places[:, 1]) <= 360)))
    if len(wrong):
        x, y, _ = points[wrong[0]]
        raise UsageError(f"{x:.1f}, {y:.1f} is no place in EPSG:{epsg} ({crs.name}): easting or longitude comes first")


def _without_epsg(georeference: Georeference) -> Georeference:
    """The georeference without the coordinate systems of the outputs."""
    return Georeference(georeference.origin, georeference.T_enu_world)
