"""Whole runs on a wrong map, mode by mode: their files, and the displacements of the buildings."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from building_errors import BuildingError, building_errors, map_errors
from numpy.typing import NDArray

import lslam
from lslam.core.config import Config
from lslam.core.config.config import load_config
from lslam.core.geometry import geodesy, se2, se3
from lslam.core.types.building import CorrectedMap, KeyframeMatch
from lslam.core.types.scan_result import KeyframeClocks
from lslam.evaluation.timing import read_timing_rows
from lslam.io.formats.osm_buildings import buildings_of, read_buildings
from lslam.io.formats.osm_files import read_osm
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.osm import location
from lslam.osm.buildings_geojson import read_buildings_geojson
from lslam.osm.track import OsmTrack
from lslam.simulation.osm_extract import read_perturbation

Floats = NDArray[np.float64]

DRIVE = Path(__file__).parents[2] / "sample_data" / "sequences" / "00"


def true_poses() -> tuple[Floats, Floats]:
    world = tomllib.loads((DRIVE / "truth" / "world.toml").read_text())
    poses = np.array(world["T_enu_world"]) @ read_trajectory(DRIVE / "truth" / "trajectory.tum").poses
    return poses, np.array(world["origin_lat_lon_alt"])


def run(folder: Path, *more: str, scans: int = 45) -> Path:
    poses, origin = true_poses()
    start = geodesy.from_local(poses[:1, :3, 3], origin)[0].tolist()
    settings = [
        f"input.count={scans}", "loops.use=false", "map.write=false", f"osm.extract={DRIVE / 'map_perturbed.osm'}",
        f"osm.origin={start}", f"osm.heading_deg={90 - np.degrees(se2.of_se3(poses[0])[2])}", *more,
    ]  # fmt: skip
    lslam.run(str(DRIVE), load_config(settings=settings), out=folder)
    return folder


def errors(folder: Path, corrected: CorrectedMap) -> list[BuildingError]:
    poses, origin = true_poses()
    record = read_perturbation(DRIVE / "truth" / "map_perturbation.json")
    truth = map_errors(read_buildings(DRIVE / "map.osm", origin)[1].buildings, record)
    first = read_trajectory(folder / "trajectory.tum").poses[:1, :3, 3]
    at = geodesy.to_local(geodesy.from_local(first, corrected.origin), origin)[0]
    return [e for e in building_errors(corrected, truth, origin, (poses[0, :3, 3] - at)[:2]) if e.status == "seen"]


@pytest.fixture(scope="module")
def two_level(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(tmp_path_factory.mktemp("osm") / "two-level")


def test_displaced_buildings_are_nearer_to_their_true_places(two_level: Path) -> None:
    found = errors(two_level, read_buildings_geojson(two_level / "buildings.geojson"))
    assert len(found) >= 5
    held = [e for e in found if e.sides == 2]
    assert np.median([e.before for e in held]) > 1.0
    assert np.median([e.after for e in held]) < 0.5
    assert np.median([e.across for e in found]) < 0.3


def test_the_change_file_holds_the_corrected_outlines(two_level: Path) -> None:
    corrected = read_buildings_geojson(two_level / "buildings.geojson")
    edited = read_osm(two_level / "buildings.osm")
    assert edited.edits
    assert {w for w in edited.ways if w < 0} <= set(read_osm(DRIVE / "map_perturbed.osm").ways)
    outlines = {b.osm_id: b for b in buildings_of(edited, corrected.origin).buildings}
    assert set(outlines) == {c.building.osm_id for c in corrected.buildings}
    for c in corrected.buildings:
        for one, other in zip(outlines[c.building.osm_id].footprints, c.real_building.footprints, strict=True):
            # Neighbours may share a corner that they want some centimetres apart.
            assert np.linalg.norm(one.outer - other.outer, axis=1).max() < 0.07


def test_every_stage_on_the_map_is_timed(two_level: Path) -> None:
    rows = read_timing_rows(two_level / "timing.csv")
    assert set(rows.back_end) >= {"walls", "map match", "building match", "graph"}
    manifest = json.loads((two_level / "manifest.json").read_text())
    keyframes = np.count_nonzero(rows.back_end["walls"])
    assert 20 <= keyframes <= 45
    assert np.count_nonzero(rows.back_end["map match"]) == keyframes
    assert np.count_nonzero(rows.back_end["graph"]) == 1
    for name, seconds in rows.back_end.items():
        assert manifest["timings"][f"{name.replace(' ', '_')}_s"] == pytest.approx(seconds.sum(), abs=0.002)


def test_the_report_has_the_building_pages(two_level: Path) -> None:
    page = (two_level / "report.html").read_text(encoding="utf-8")
    for words in ("Buildings before and after", "Where the map held the trajectory", "Displacement of buildings",
                  "Matches of walls"):  # fmt: skip
        assert words in page


@pytest.mark.usefixtures("starts_sought_anew")
def test_the_same_run_writes_the_same_bytes(two_level: Path, tmp_path: Path) -> None:
    again = run(tmp_path / "again")
    for name in ("buildings.geojson", "buildings.osm", "osm_matches.csv", "trajectory.tum"):
        assert (again / name).read_bytes() == (two_level / name).read_bytes(), name


@pytest.mark.parametrize("mode", ["prior", "rigid", "non-rigid"])
def test_every_mode_moves_its_own_variables_only(mode: str, tmp_path: Path) -> None:
    folder = run(tmp_path / "run", f"osm.mode={mode}", scans=30)
    corrected = read_buildings_geojson(folder / "buildings.geojson")
    moves = np.array([c.displacement for c in corrected.buildings])
    assert corrected.mode == mode
    if mode == "prior":
        assert not moves.any()
    elif mode == "rigid":
        np.testing.assert_allclose(moves[:, :2], np.tile(corrected.shift, (len(moves), 1)), atol=0.02)
    else:
        assert np.median([e.across for e in errors(folder, corrected)]) < 0.4
        assert np.ptp(moves[:, 0]) > 0.2


def test_backward_matching_begins_at_a_match_of_full_rank(monkeypatch: pytest.MonkeyPatch) -> None:
    def sight(number: int, rank: int) -> KeyframeMatch:
        information = np.diag([9.0, 0.0 if rank < 3 else 9.0, 100.0])
        return KeyframeMatch(number, np.zeros((0, 2, 2)), np.zeros((1, 2)), np.zeros(3), np.ones(3), np.zeros(3), information,
                             rank, "edges" if rank == 3 else "lines", verdict="accepted" if rank else "rejected")  # fmt: skip

    asked: list[list[int]] = []

    def along(numbers: Iterable[int], *_: object) -> list[KeyframeMatch]:
        asked.append(list(numbers))
        return [sight(k, [0, 2, 0, 3][k]) for k in asked[-1]]

    monkeypatch.setattr(location, "_along", along)
    track = OsmTrack(np.zeros(3), np.ones(3), 1.0, 1e-4, np.ones(3))
    run = location.LevelRun([0] * 4, np.zeros((4, 4, 4)), Config())  # type: ignore[arg-type]
    found = location._both_ways(run, None, track, KeyframeClocks())  # type: ignore[arg-type]
    assert asked == [[0, 1, 2, 3], [2, 1, 0]]
    assert [m.keyframe for m in found] == [0, 1, 2, 3]


def test_a_match_far_from_odometry_is_refused() -> None:
    config = Config()
    track = OsmTrack(np.zeros(3), np.array([0.1, 0.1, 0.01]), 1.0, 1e-4, np.array([0.5, 0.5, 0.02]))
    near = KeyframeMatch(
        4, np.zeros((0, 2, 2)), np.zeros((1, 2)), np.zeros(3), np.ones(3), np.array([0.4, -0.3, 0.0]),
        np.diag([100.0, 100.0, 1e4]), 3, "edges", pairs=np.zeros((5, 2), np.int64),
    )  # fmt: skip
    assert location._gate(near, track, config.osm, config.graph).verdict == "accepted"
    far = location._gate(replace(near, pose=np.array([4.0, -3.0, 0.0])), track, config.osm, config.graph)
    assert far.verdict == "rejected"
    assert far.reason.endswith("times as far from odometry as it may have drifted")


@pytest.mark.parametrize(
    ("is_trusted", "how"),
    [
        (True, "osm.mode=two-level"),
        (False, "osm.mode=two-level"),
        (True, "osm.mode=non-rigid"),
        (True, "osm.matcher=baseline"),
    ],
)
def test_trusted_poses_are_not_changed(is_trusted: bool, how: str, tmp_path: Path) -> None:
    given = DRIVE / "truth" / "trajectory.tum"
    trust = f"osm.trust_poses={str(is_trusted).lower()}"
    folder = run(tmp_path / "run", "odometry.method=poses", f"odometry.poses={given}", trust, how, scans=30)
    real, found = read_trajectory(given).poses[:30], read_trajectory(folder / "trajectory.tum").poses
    bent = se3.relative(se3.relative(real[:1], real), se3.relative(found[:1], found))
    away = np.linalg.norm(bent[:, :3, 3], axis=1).max()
    assert (away < 0.005) == is_trusted
    corrected = read_buildings_geojson(folder / "buildings.geojson")
    assert corrected.mode == ("baseline" if "baseline" in how else how.removeprefix("osm.mode="))
    if corrected.mode != "baseline":
        assert np.median([e.across for e in errors(folder, corrected)]) < 0.3


def test_the_baseline_runs_whole(tmp_path: Path) -> None:
    folder = run(tmp_path / "run", "odometry.preset=thesis-baseline", "loops.use=false", scans=30)
    corrected = read_buildings_geojson(folder / "buildings.geojson")
    assert corrected.mode == "baseline"
    seen = [c for c in corrected.buildings if c.status == "seen"]
    assert len(seen) >= 3
    first = min(seen, key=lambda c: float(np.linalg.norm(c.displacement)))
    assert np.abs(first.displacement).max() < 0.001
    poses, _ = true_poses()
    found = read_trajectory(folder / "trajectory.tum").poses
    length = np.linalg.norm(found[-1, :2, 3] - found[0, :2, 3])
    # Its odometry claims metres per step, as much as each building does: these drag it.
    assert length == pytest.approx(np.linalg.norm(poses[29, :2, 3] - poses[0, :2, 3]), abs=1.0)
    # A graph of two dimensions: heights and tilts from one scan to the next are those of odometry.
    before = read_trajectory(folder / "trajectory_odometry.tum").poses
    steps, own = se3.relative(found[:-1], found[1:]), se3.relative(before[:-1], before[1:])
    np.testing.assert_allclose(steps[:, 2, 3], own[:, 2, 3], atol=5e-3)
    np.testing.assert_allclose(steps[:, 2, :2], own[:, 2, :2], atol=3e-4)


def test_the_improved_system_matches_single_scans_and_keeps_its_start(tmp_path: Path) -> None:
    folder = run(tmp_path / "run", "odometry.preset=thesis-improved", "loops.use=false", scans=30)
    corrected = read_buildings_geojson(folder / "buildings.geojson")
    assert corrected.mode == "two-level"
    assert np.abs(corrected.shift).max() < 0.001, "its map is not off as a whole"
    rows = read_timing_rows(folder / "timing.csv")
    assert "drift" not in rows.back_end, "nothing sets its odometry straight"
    assert rows.back_end["walls"].sum() > 0
    poses, _ = true_poses()
    found = read_trajectory(folder / "trajectory.tum").poses
    assert np.abs(found[0, :2, 3]).max() < 1.5, "the first fix is the origin of its map"
    length = np.linalg.norm(found[-1, :2, 3] - found[0, :2, 3])
    # The map lies 1.5 m off, which nothing in the system may say: it bends the run.
    assert length == pytest.approx(np.linalg.norm(poses[29, :2, 3] - poses[0, :2, 3]), abs=2.5)
