"""Walls of analytic scenes and of a simulated town: found where they are, facing the sensor, and nothing else found."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from wall_scenes import Floats, block, box_at, misfit, noisy, plain, turned, upright

from lslam.core.config.backend import OsmConfig
from lslam.core.geometry import se3
from lslam.core.types.building import Building, Footprint
from lslam.io.formats.osm_buildings import read_buildings
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.osm.walls import Walls, find_walls, walls_of

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
HOUSE = box_at(6, -4, 12, 9)


def edges(corners: list[tuple[float, float]]) -> Floats:
    return np.array(list(zip(corners, corners[1:] + corners[:1], strict=True)))


def test_the_walls_of_a_house_are_found_to_the_centimetre_and_face_outwards() -> None:
    west, north = edges(HOUSE)[3], edges(HOUSE)[2]
    seen = [upright(tuple(wall[0]), tuple(wall[1]), 0, 6) for wall in (west, north)]
    walls = find_walls(noisy(np.concatenate([plain(), *seen])), views=np.array([[-10.0, 12.0]]))
    off, beyond, angle, which = misfit(walls.segments, edges(HOUSE))
    assert sorted(which.tolist()) == [2, 3]
    assert off.max() < 0.02
    assert beyond.max() < 0.15
    assert angle.max() < 0.2, "directed as the outline is"
    np.testing.assert_allclose(walls.lengths[np.argsort(which)], [12, 9], atol=0.2)
    np.testing.assert_allclose(walls.rms, 0.02 / np.sqrt(4), atol=0.02)
    inside = find_walls(noisy(np.concatenate([plain(), *seen])), views=np.array([[12.0, 0.0]]))
    assert misfit(inside.segments[:, ::-1], edges(HOUSE))[2].max() < 0.2


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.7), (3.1, -2.2, 2.5), (-5.0, 4.0, -1.3)])
def test_walls_move_with_the_cloud(pose: tuple[float, float, float]) -> None:
    cloud = noisy(np.concatenate([plain(60), block(HOUSE, 0, 6), block(box_at(-20, 8, 9, 7), 0, 5)]))
    moved = cloud.copy()
    moved[:, :2] = turned(cloud[:, :2].astype(np.float64), pose)
    here = find_walls(cloud)
    there = find_walls(moved, views=np.array([pose]))
    assert len(here) == len(there) == 8
    off, beyond, angle, which = misfit(there.segments, turned(here.segments, pose))
    assert sorted(which) == list(range(8))
    assert off.max() < 0.03
    assert beyond.max() < 0.35
    assert angle.max() < 0.2


def test_height_counts_from_the_ground_wherever_that_is() -> None:
    level = np.concatenate([plain(), block(HOUSE, 0, 6), upright((-12, 3), (-2, 3), 0, 1.5)])
    expected = len(find_walls(noisy(level)))
    assert expected == 4, "the garden wall is too low"
    assert len(find_walls(noisy(level - [0, 0, 30]))) == expected, "seen by a drone"
    slope = level.copy()
    slope[:, 2] += 0.12 * slope[:, 0] + 0.05 * slope[:, 1]
    assert len(find_walls(noisy(slope))) == expected
    assert len(find_walls(noisy(level), OsmConfig(wall_height=0.5))) > expected


def test_other_surfaces_give_no_walls() -> None:
    rng = np.random.default_rng(1)
    foliage = rng.normal(0, 1.5, (4000, 3)) * [1, 1, 0.7] + [10, 5, 5]
    x, y = np.meshgrid(np.arange(5, 15, 0.2), np.arange(-15, -5, 0.2))
    roof = np.column_stack([x.ravel(), y.ravel(), 4 + 0.7 * (x.ravel() - 5)])
    pole = np.column_stack([np.full(60, -8.0), np.full(60, 2.0), np.linspace(0, 6, 60)])
    cars = [block(box_at(x, 6, 1.8, 4.4), 0, 1.5) for x in (-20.0, -15.0, -10.0)]
    assert len(find_walls(noisy(np.concatenate([plain(), foliage, roof, pole, *cars])))) == 0
    assert len(find_walls(noisy(plain()))) == 0


def test_two_houses_in_line_are_two_walls_and_a_narrow_gap_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud = np.concatenate([plain(), upright((-12, 8), (-3, 8), 0, 5), upright((-1, 8), (8, 8), 0, 5)])
    two = find_walls(noisy(cloud))
    assert sorted(np.round(two.lengths).tolist()) == [9.0, 9.0]
    monkeypatch.setattr("lslam.osm.walls.WALL_GAP_M", 3.0)
    assert len(find_walls(noisy(cloud))) == 1


def test_a_round_building_and_a_little_one_break_nothing() -> None:
    ring = [(20 + 9 * np.cos(a), 9 * np.sin(a)) for a in np.arange(0, 2 * np.pi, 0.05)]
    cloud = np.concatenate([plain(), block(ring, 0, 5), block(box_at(-8, -8, 1.5, 1.5), 0, 4)])
    walls = find_walls(noisy(cloud))
    away = np.abs(np.linalg.norm(walls.segments - [20, 0], axis=2) - 9)
    assert away.max() < 0.2
    assert 4 <= len(walls) <= 30


@pytest.mark.parametrize("count", [0, 1, 30])
def test_few_points_give_no_walls(count: int) -> None:
    cloud = np.zeros((count, 3), np.float32)
    assert find_walls(cloud).segments.shape == (0, 2, 2)
    cloud[:, 1] = np.nan
    assert len(find_walls(cloud)) == 0


def test_the_same_cloud_gives_the_same_bytes() -> None:
    cloud = noisy(np.concatenate([plain(), block(HOUSE, 0, 6)]))
    one, other = find_walls(cloud), find_walls(cloud.copy())
    assert one.segments.tobytes() == other.segments.tobytes()
    assert one.counts.tolist() == other.counts.tolist()


def test_walls_of_a_map_face_outwards_and_have_no_corners_too_many() -> None:
    outer = np.array([[0, 0], [5, 0.02], [10, 0], [10, 8], [0, 8]], np.float64)
    hole = np.array([[3, 3], [3, 5], [5, 5], [5, 3]], np.float64)
    house = Building("way/1", (Footprint(outer, (hole,)),))
    carport = Building("way/2", (Footprint(outer + 20),), tags={"building": "carport"})
    segments, owners = walls_of([carport, house])
    assert owners.tolist() == [1] * 8
    right = np.stack([(d := segments[:, 1] - segments[:, 0])[:, 1], -d[:, 0]], axis=1)
    probes = segments.mean(1) + 0.1 * right / np.linalg.norm(right, axis=1, keepdims=True)
    inside = [0 < x < 10 and 0 < y < 8 and not (3 < x < 5 and 3 < y < 5) for x, y in probes]
    assert not any(inside)
    assert walls_of([])[0].shape == (0, 2, 2)


def submap(numbers: list[int]) -> tuple[Walls, Floats]:
    """Walls in scans of the sample, in the city's frame by the exact poses, and where they were seen from."""
    sequence = open_sequence(SAMPLE)
    folder = SAMPLE / "sequences" / "00" / "truth"
    T_enu_world = np.array(tomllib.loads((folder / "world.toml").read_text())["T_enu_world"])
    truth = read_trajectory(folder / "trajectory.tum").poses
    poses = [T_enu_world @ truth[i] for i in numbers]
    clouds = [se3.apply(T, sequence.scan(i).points.astype(np.float64)) for T, i in zip(poses, numbers, strict=True)]
    centre = poses[len(poses) // 2][:3, 3]
    views = np.array([T[:3, 3] for T in poses]) - centre
    walls = find_walls(np.concatenate(clouds) - centre, OsmConfig(), views)
    return walls, centre[:2]


def test_walls_of_a_simulated_town_lie_on_its_footprints() -> None:
    extract = read_buildings(SAMPLE / "sequences" / "00" / "map.osm", np.array([49.0, 8.4, 115.0]))[1]
    truth, _ = walls_of(extract.buildings)
    good = total = 0.0
    for first in (5, 35, 65):
        walls, centre = submap(list(range(first, first + 10)))
        assert len(walls) >= 8
        off, beyond, angle, _ = misfit(walls.segments + centre, truth)
        is_good = (off < 0.1) & (beyond < 0.6) & (angle < 2.0)
        good += walls.lengths[is_good].sum()
        total += walls.lengths.sum()
    assert total > 150
    assert good / total > 0.75, "the rest are bays and garden walls, which no map has"
