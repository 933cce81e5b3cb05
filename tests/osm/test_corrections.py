"""From matches to a corrected map: a street of houses drawn wrong on the map, seen from known poses."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from shapely import Polygon

from lslam.core.config.backend import OsmConfig
from lslam.core.geometry import se2
from lslam.core.types.building import Building, BuildingMatch, CorrectedMap, Footprint, KeyframeMatch, OsmMatches
from lslam.osm.corrections import correct_buildings
from lslam.osm.wall_match import match_walls
from lslam.osm.walls import walls_of

Floats = NDArray[np.float64]
Mode = Literal["prior", "rigid", "non-rigid", "two-level"]

SIGMA = np.array([1.0, 1.0, np.radians(2.0)])


def house(k: int, x: float, y: float, width: float, depth: float) -> Building:
    corners = np.array([[x, y], [x + width, y], [x + width, y + depth], [x, y + depth]])
    return Building(f"way/{k}", (Footprint(corners),), tags={"building": "yes"})


def scene(seed: int, shift: tuple[float, float] = (1.0, -0.6)) -> tuple[OsmMatches, Floats, list[Building], Floats]:
    """Matches, keyframes, the houses as they stand, and their displacement against the map, all known.

    The last house on the map is gone; one was built that the map has not; the last but one is far from the way.
    """
    rng = np.random.default_rng(seed)
    real = [house(k, 16.0 * (k // 2), -14.0 - 9 * (k % 2) if k % 2 else 8.0, 9.0 + k % 3, 8.0) for k in range(10)]
    off = np.column_stack([shift + rng.uniform(-1, 1, (10, 2)), rng.uniform(-0.04, 0.04, 10)])
    on_map = [b.transform(np.eye(2), -d[:2]).displace(np.array([0, 0, -d[2]])) for b, d in zip(real, off, strict=True)]
    far, gone, new = house(10, 400, 400, 9, 9), house(11, 88, 8, 9, 9), house(12, 100, -16, 10, 9)
    hall = house(13, 70, 30, 50, 12)
    on_map += [far.transform(np.eye(2), -np.array(shift)), gone.transform(np.eye(2), -np.array(shift)), hall]
    ground = [*real, new, hall]
    poses = np.column_stack([np.linspace(-5, 110, 30), np.zeros(30), rng.uniform(-0.3, 0.3, 30)])
    walls, _ = walls_of(ground)
    keyframes, local = [], []
    for k, pose in enumerate(poses):
        u = walls[:, 1] - walls[:, 0]
        faces = u[:, 0] * (walls[:, 0, 1] - pose[1]) - u[:, 1] * (walls[:, 0, 0] - pose[0]) > 0
        near = np.linalg.norm(walls.mean(axis=1) - pose[:2], axis=1) < 40
        seen = walls[faces & near] + rng.normal(0, 0.03, (int((faces & near).sum()), 2, 2))
        sight = KeyframeMatch(
            k, se2.apply(se2.inverse(pose), seen), np.zeros((1, 2)), pose, np.ones(3), pose, np.eye(3)
        )
        keyframes.append(sight)
        for number, building in enumerate(on_map):
            if np.linalg.norm(building.middle - pose[:2]) > 35:
                continue
            outline = walls_of([building])[0] - building.middle
            prior = se2.relative(pose, np.append(building.middle + shift, 0.0))
            found = match_walls(outline, sight.walls, prior, SIGMA, OsmConfig(), by_coverage=True)
            if found is not None:
                local.append(BuildingMatch(
                    k, number, found.pose, found.information, found.rank, found.kind, found.fitness, found.coverage,
                    found.rms, found.pairs, "rejected" if found.is_ambiguous else "accepted", "",
                ))  # fmt: skip
    known, owners = walls_of(on_map)
    matches = OsmMatches(
        np.array([49.0, 8.4, 0.0]), tuple(on_map), known, owners, tuple(keyframes), tuple(local),
        attribution="© OpenStreetMap contributors",
    )  # fmt: skip
    return matches, poses, [*real, far, gone, hall], np.array([*off, [*shift, 0], [*shift, 0], [0, 0, 0]])


def solved(seed: int, mode: Mode = "two-level") -> tuple[CorrectedMap, Floats, list[Building], OsmMatches]:
    matches, poses, real, off = scene(seed)
    return correct_buildings(matches, poses, OsmConfig(mode=mode)), off, real, matches


@pytest.mark.parametrize("seed", range(3))
def test_corrected_buildings_are_at_their_true_places(seed: int) -> None:
    found, off, real, matches = solved(seed)
    assert [c.building for c in found.buildings] == list(matches.buildings)
    two_sided = [k for k in range(10) if any(m.building == k and m.rank == 3 for m in matches.local)]
    assert len(two_sided) >= 8
    corners = [
        np.linalg.norm(found.buildings[k].real_building.footprints[0].outer - real[k].footprints[0].outer, axis=1).max()
        for k in two_sided
    ]
    assert np.median(corners) < 0.3
    assert np.linalg.norm(off[:10, :2], axis=1).mean() > 0.8
    assert all(found.buildings[k].status == "seen" and found.buildings[k].used_matches > 2 for k in two_sided)
    assert min(found.buildings[k].confidence for k in two_sided) > 0.5
    np.testing.assert_allclose(found.shift, [1.0, -0.6], atol=0.5)
    assert found.overlaps == ()
    assert found.attribution == "© OpenStreetMap contributors"


def test_absent_new_and_unobserved_buildings_are_distinguished() -> None:
    found, _, _, _ = solved(0)
    assert [c.status for c in found.buildings[10:12]] == ["unseen", "absent"]
    np.testing.assert_allclose(found.buildings[10].displacement[:2], found.shift, atol=1e-6)
    assert found.buildings[10].used_matches == found.buildings[11].used_matches == 0
    assert found.buildings[10].confidence < 0.3
    front = found.new_walls[np.abs(found.new_walls[:, :, 1] + 7).max(axis=1) < 0.4]
    assert len(front) == 1
    np.testing.assert_allclose(np.sort(front[0, :, 0]), [100, 110], atol=0.4)


def test_mode_prior_keeps_the_map_and_mode_rigid_shifts_it() -> None:
    fixed, _, _, _ = solved(1, "prior")
    assert not any(c.displacement.any() for c in fixed.buildings)
    assert not fixed.shift.any()
    # Where nothing is applied that was seen, a building stands within the map's own errors: 1 m, and 2 m of the whole.
    np.testing.assert_allclose([c.covariance[:2, :2] for c in fixed.buildings], np.tile(5.0 * np.eye(2), (13, 1, 1)))
    assert max(c.confidence for c in fixed.buildings) < 0.05
    rigid, _, _, _ = solved(1, "rigid")
    moves = np.array([c.displacement for c in rigid.buildings])
    np.testing.assert_allclose(moves[:, :2], np.tile(rigid.shift, (len(moves), 1)), atol=0.01)
    np.testing.assert_allclose(rigid.shift, [1.0, -0.6], atol=0.6)


def test_overlapping_neighbours_are_separated() -> None:
    matches, poses, _, _ = scene(2)
    first = matches.buildings[0]
    copy = Building("way/99", (Footprint(np.add(first.footprints[0].outer, [7.0, 0.0])),), tags=first.tags)
    more = OsmMatches(
        matches.origin, (*matches.buildings, copy), matches.map_walls, matches.owners, matches.keyframes, matches.local
    )
    found = correct_buildings(more, poses, OsmConfig())
    shapes = [Polygon(c.real_building.footprints[0].outer).buffer(-0.01) for c in found.buildings]
    assert not shapes[0].intersects(shapes[-1])
    assert found.overlaps == ()


def test_without_matches_the_map_keeps_its_prior() -> None:
    matches, poses, _, _ = scene(0)
    blind = OsmMatches(
        matches.origin,
        matches.buildings,
        matches.map_walls,
        matches.owners,
        (),
        (),
        np.array([0.5, 0.5]),
        np.full(2, 0.1),
    )
    found = correct_buildings(blind, poses, OsmConfig())
    assert {c.status for c in found.buildings} == {"unseen"}
    np.testing.assert_allclose([c.displacement[:2] for c in found.buildings], 0.5, atol=0.02)
