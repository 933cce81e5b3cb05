"""How far corrected buildings stand from where they really are, where that is known: simulated maps with a record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.geometry import geodesy, se2
from lslam.core.types.building import Building, BuildingCorrection, BuildingStatus, CorrectedMap
from lslam.simulation.osm_extract import Perturbation, join_outlines, perturb, simplify_outlines

HELD = 0.6  # m; one sigma along an axis below which walls hold it: a building that nothing holds has 1 m


@dataclass(frozen=True)
class BuildingError:
    """One building of the map.

    before, after : m, distance of its middle from the true one, as on the map and corrected
    across : m, the part of `after` along the axis that is known best; turn : rad, what is left of its turn
    sides : 0 nothing holds it, 1 walls of one direction, 2 of two
    """

    osm_id: str
    status: BuildingStatus
    sides: int
    before: float
    after: float
    across: float
    turn: float


def building_errors(
    found: CorrectedMap, truth: Mapping[str, Floats], origin: Floats, shift: Floats
) -> list[BuildingError]:
    """Errors of the buildings whose true displacement (3,) is in `truth`, by number, with the run begun at its true start.

    Its heading is the map's own: nothing turns it.

    origin : (3,) lat, lon (deg), height (m) of the frame in which `truth` was measured
    shift : (2,) m, lays the run's first position, carried to that frame, on the true one
    """
    return [
        _error(c, truth[c.building.osm_id], found.origin, origin, shift)
        for c in found.buildings
        if c.building.osm_id in truth
    ]


def _error(
    correction: BuildingCorrection, real: Floats, run_origin: Floats, origin: Floats, shift: Floats
) -> BuildingError:
    def carried(place: Floats) -> Floats:
        fix = geodesy.from_local(np.append(place, 0.0)[None], run_origin)
        return np.asarray(geodesy.to_local(fix, origin)[0, :2])

    middle = correction.building.middle
    on_map = carried(middle)
    stands = carried(middle + correction.displacement[:2]) + shift
    away = stands - on_map - real[:2]
    values, axes = np.linalg.eigh(correction.covariance[:2, :2])
    turn = float(se2.wrap(correction.displacement[2] - real[2]))
    return BuildingError(
        correction.building.osm_id, correction.status, int((np.sqrt(values) < HELD).sum()),
        float(np.linalg.norm(real[:2])), float(np.linalg.norm(away)), float(abs(away @ axes[:, 0])), turn,
    )  # fmt: skip


def map_errors(buildings: Sequence[Building], perturbation: Perturbation) -> dict[str, Floats]:
    """By number, what moves each building of the perturbed map to where it really stands: x, y (m), yaw (rad) about its middle.

    buildings : the exact map. Buildings that are not built yet stand nowhere, and missing ones are on no map.
    """
    known, on_map = {b.osm_id: b for b in buildings}, {b.osm_id: b for b in perturb(buildings, perturbation)}
    found = {}
    for change in perturbation.changes:
        if change.id not in on_map:
            continue
        real, drawn = join_outlines(known[change.id], change, known), on_map[change.id]
        real = simplify_outlines(real, change.simplify_m) if change.simplify_m > 0 else real
        moved = drawn.displace(np.array([0.0, 0.0, -change.turn_rad]))
        found[change.id] = np.array([*(real.middle - moved.middle), -change.turn_rad])
    return found
