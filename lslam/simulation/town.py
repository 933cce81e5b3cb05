"""A town of many streets round a given line: side streets, crossings with open kerbs, and rows of houses."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.geometry import portable
from lslam.simulation.city import (
    City,
    Layout,
    Lots,
    StreetSite,
    add_garden_trees,
    add_ground,
    add_road,
    add_row,
    add_street_furniture,
)
from lslam.simulation.curve import RouteCurve, Terrain, smooth_curve

SHORTEST_SIDE_M = 30.0  # m of a side street
LONGEST_SIDE_M = 110.0
ROW_M = 12.0  # m left between streets for a row of houses
CAR_LENGTH = 5.2  # m kept between the middles of parked cars


class Network:
    """Middles of all roads, for distances to the nearest one."""

    def __init__(self, streets: list[RouteCurve]) -> None:
        from scipy.spatial import cKDTree

        self.streets = streets
        self._tree = cKDTree(np.concatenate([street.position(street.sample(0.25)) for street in streets]))

    def distance(self, xy: NDArray[Any]) -> Floats:
        """Distance of places (..., 2) to the nearest middle of a road, m, shape (...)."""
        return np.asarray(self._tree.query(xy)[0])


def build_town(
    main: list[RouteCurve],
    terrain: Terrain,
    layout: Layout,
    rng: np.random.Generator,
    spacing: float = 80.0,
    levels: int = 1,
) -> City:
    """Build a town round the streets `main`. The same generator state gives the same town.

    spacing : m between the side streets of a street, about; levels : 0 for no side streets, 1 for those of `main`, 2 for
        theirs as well
    """
    streets, newest = main, main
    for _ in range(levels):
        newest = _side_streets(newest, streets, layout, spacing, rng)
        streets = [*streets, *newest]
    network = Network(streets)
    place = StreetSite.begin(main[0], terrain, layout, rng)
    sites = [place.along(street) for street in streets]
    for site in sites:
        add_road(site, network.distance)
    # Grass closes the dead ends: their last metres do not count as road.
    add_ground(place, [_shorten(street, layout.band) for street in streets], 0.75 * layout.pavement)
    lots = Lots(streets, layout)
    for first in (True, False):
        for site in sites if first else sites[: len(main)]:
            for side in (1, -1):
                add_row(site, lots, side, first)
    places = Places(network, layout)
    for site in sites:
        for side in (1, -1):
            add_street_furniture(site, side, places)
    add_garden_trees(place, lots)
    return City(place.builder.build(), terrain, main[0], lots.footprints, lots.heights, streets)


class Places:
    """Test of free places beside a street: off other roads, and clear of earlier objects."""

    def __init__(self, network: Network, layout: Layout) -> None:
        self._network, self._road = network, layout.road
        self._taken = np.zeros((0, 2))

    def __call__(self, xy: Floats, offset: float, yaw: float) -> bool:
        """Whether an object at `xy` (2,), `offset` m from the axis of its street, has room; then it is recorded as occupied.

        yaw : rad, along which a car is long; what stands on the road is a car
        """
        is_car = offset < self._road
        if self._network.distance(xy) < offset - (0.15 if is_car else 0.05):
            return False
        # Nor may a car's ends reach into another road.
        half = 0.5 * CAR_LENGTH * np.array([portable.cos(yaw), portable.sin(yaw)])
        if is_car and self._network.distance(np.stack([xy - half, xy + half])).min() < offset - 0.7:
            return False
        apart = CAR_LENGTH if is_car else 0.9
        if len(self._taken) and portable.hypot(*(self._taken - xy).T).min() < apart:
            return False
        self._taken = np.concatenate([self._taken, xy[None]])
        return True


def _shorten(street: RouteCurve, by: float) -> RouteCurve:
    """Open street without its first and last metres; returned unchanged if it is too short."""
    if street.closed or street.length < 2 * by + SHORTEST_SIDE_M / 2:
        return street
    s = np.linspace(by, street.length - by, max(int(street.length), 12))
    return smooth_curve(street.position(s), closed=False)


def _side_streets(
    main: list[RouteCurve], streets: list[RouteCurve], layout: Layout, spacing: float, rng: np.random.Generator
) -> list[RouteCurve]:
    """Streets off `main` on both sides. Each ends at one of `streets` or at an earlier side street, or at its own length.

    spacing : m, mean between two on one side
    """
    from scipy.spatial import cKDTree

    street_tree = np.concatenate([street.position(street.sample(0.5)) for street in streets])
    out: list[RouteCurve] = []
    for street in main:
        for side in (1, -1):
            s = rng.uniform(0.3, 0.8) * spacing
            while s < street.length - 0.3 * spacing:
                at = np.array([s])
                s += spacing * rng.uniform(0.75, 1.3)
                turn, length = rng.normal(0, 0.07), rng.uniform(0.5, 1.0) * LONGEST_SIDE_M
                if abs(float(street.curvature(at)[0])) > 0.02:
                    continue
                tangent = street.tangent(at)[0] * side
                heading = portable.arctan2(tangent[1], tangent[0]) + np.pi / 2 + turn
                ray = np.array([portable.cos(heading), portable.sin(heading)])
                line = _street_until_crossing(street.position(at)[0], ray, length, cKDTree(street_tree), layout)
                if line is not None:
                    out.append(line)
                    street_tree = np.concatenate([street_tree, line.position(line.sample(0.5))])
    return out


def _street_until_crossing(
    start: Floats, ray: Floats, length: float, street_tree: Any, layout: Layout
) -> RouteCurve | None:
    """Straight street from `start` along `ray` (2,) until it meets another; None when it would run too close to one.

    length : m, where it meets none; street_tree : KD-tree of points on the other streets
    """
    steps = np.arange(0.0, length, 0.5)
    points = start + steps[:, None] * ray
    away = np.asarray(street_tree.query(points)[0])
    room = 2 * layout.band + ROW_M
    clear = steps > 1.25 * room
    met = np.flatnonzero(clear & (away < 0.5))
    end = int(met[0]) + 1 if len(met) else len(steps)
    if steps[end - 1] < SHORTEST_SIDE_M:
        return None
    # Only where it meets another street may it come near to one: beside it there would be no room for houses.
    near = np.count_nonzero(clear[:end] & (away[:end] < room)) * 0.5
    if near > (1.25 * room if len(met) else 0.0):
        return None
    return smooth_curve(points[[0, end - 1]], closed=False)
