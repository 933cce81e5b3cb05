"""From fixes and odometry to a place on the Earth, through pyproj and back."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from stub_sequences import Stub

from lslam.backend.georeferencing import place, require_gnss
from lslam.backend.graph.odometry_constraints import odometry_constraints
from lslam.backend.graph.problem import PoseGraph
from lslam.core.config import Config
from lslam.core.config.backend import GnssConfig
from lslam.core.errors import InputError, UsageError
from lslam.core.geometry import geodesy, se3, so3
from lslam.core.types.gnss import GnssStream
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Calibration
from lslam.core.types.trajectory import Keyframe

ORIGIN = np.array([49.0, 8.4, 115.0])
ARM = np.array([-0.9, 0.1, 0.6])
COUNT = 400
PHASE = np.linspace(0, 2 * np.pi, COUNT)
# A lap of 380 m about a point of the city, and where odometry's world has it: at the first scan.
POSES = se3.make(
    so3.from_euler_rpy(np.column_stack([0 * PHASE, 0 * PHASE, PHASE + 0.5 * np.pi])),
    np.column_stack([60 * np.cos(PHASE) + 200, 60 * np.sin(PHASE) - 90, 0 * PHASE + 3]),
)
STAMPS = np.arange(COUNT, dtype=np.int64) * 100_000_000
RESULTS = [ScanResult(i, int(STAMPS[i]), T) for i, T in enumerate(se3.inverse(POSES[0]) @ POSES)]
KEYFRAMES = [Keyframe(n, i, int(STAMPS[i]), RESULTS[i].T_world_lidar) for n, i in enumerate(range(0, COUNT, 10))]


def recording(noise: float, seed: int = 0) -> Stub:
    """Fixes at 5 Hz, between scans."""
    stamps = STAMPS[:-1:2] + 37_000_000
    share = 0.37
    middle = POSES[:-1:2, :3, 3] * (1 - share) + POSES[1::2, :3, 3] * share
    antenna = middle + POSES[:-1:2, :3, :3] @ ARM
    error = noise * np.random.default_rng(seed).normal(size=antenna.shape) * [1, 1, 1.8]
    fixes = geodesy.from_local(antenna + error, ORIGIN)
    calibration = Calibration(T_lidar_gnss=se3.make(np.eye(3), ARM))
    stream = GnssStream(stamps, fixes, np.full(len(stamps), max(noise, 0.02)))
    return Stub(["none"] * COUNT, calibration=calibration, gnss=stream)


def error_on_earth(found, points: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(N, 3) m, of points of odometry's world carried to lat, lon, height and back to the city's frame."""
    world = geodesy.from_local(se3.apply(found.T_enu_world, points), found.origin)
    return geodesy.to_local(world, ORIGIN) - truth


def fit(sequence: Stub, up: np.ndarray | None = None, **settings: object):
    config = Config.model_validate({"gnss": {"mode": "fit", **settings}})
    poses = np.stack([k.T_world_lidar for k in KEYFRAMES])
    graph = PoseGraph(poses, odometry_constraints(KEYFRAMES, RESULTS, config.graph))
    return place(sequence, RESULTS, KEYFRAMES, up, graph, config)


def test_perfect_fixes_give_the_place_to_millimetres() -> None:
    found = fit(recording(0.0), crs=25832).georeference
    own = np.stack([r.T_world_lidar[:3, 3] for r in RESULTS])
    assert np.abs(error_on_earth(found, own, POSES[:, :3, 3])).max() < 5e-3
    assert (found.fixes, found.used, found.epsg, found.method) == (200, 200, 25832, "fit")
    # The origin is the first fix: nothing lies far from it.
    assert np.linalg.norm(geodesy.to_local(found.origin[None], ORIGIN)[0] - POSES[0, :3, 3]) < 2


def test_noise_of_a_metre_gives_the_place_to_decimetres() -> None:
    found = fit(recording(1.0), np.array([0.0, 0, 1])).georeference
    own = np.stack([r.T_world_lidar[:3, 3] for r in RESULTS])
    off = error_on_earth(found, own, POSES[:, :3, 3])
    assert np.sqrt((off[:, :2] ** 2).sum(1).mean()) < 0.3
    assert 1.2 < found.rmse_horizontal < 1.6  # two axes of 1 m each


def test_factors_place_the_antenna_from_their_keyframe() -> None:
    """Position minus arm, by the true pose of the keyframe, is nothing but the fix's noise."""
    placement = fit(recording(0.0), mode="graph")
    T = placement.georeference.T_enu_world
    assert len(placement.fixes) == 200
    for fix in placement.fixes:
        seen = se3.apply(T @ KEYFRAMES[fix.keyframe].T_world_lidar, fix.arm[None])[0]
        np.testing.assert_allclose(seen, fix.position, atol=1e-2)


def bad(name: str) -> Stub:
    sequence = recording(0.5)
    stream = sequence.gnss
    places, sigma = stream.lat_lon_alt.copy(), stream.sigma.copy()
    if name == "zeros":
        places[:] = 0
    elif name == "hemisphere":
        places[:, 0] *= -1
    elif name == "sigma":
        sigma[:] = 500.0
    elif name == "random":
        places[:, :2] += np.random.default_rng(1).normal(size=(len(places), 2)) * 0.01
    elif name == "apart":
        return replace(sequence, gnss=replace(stream, stamps_ns=stream.stamps_ns + 10**12))
    return replace(sequence, gnss=replace(stream, lat_lon_alt=places, sigma=sigma))


@pytest.mark.parametrize("name", ["zeros", "hemisphere", "sigma", "random", "apart"])
def test_fixes_that_are_all_bad_are_refused_with_a_reason(name: str) -> None:
    placement = fit(bad(name))
    assert placement.georeference is None
    assert placement.problem.startswith("GNSS: ")


def test_too_few_that_agree_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of six jump: four are the most of them, and not five."""
    sequence = recording(0.1)
    stream = sequence.gnss
    places, some = stream.lat_lon_alt[::35].copy(), stream.stamps_ns[::35]
    places[[2, 4], 0] += [0.002, 0.003]
    few = replace(sequence, gnss=replace(stream, stamps_ns=some, lat_lon_alt=places, sigma=stream.sigma[::35]))
    refused = fit(few)
    assert refused.georeference is None
    assert "half of 6 fixes, and 5 at the least: all" in refused.problem
    monkeypatch.setattr("lslam.backend.georeferencing.MIN_FIXES", 4)
    assert fit(few).georeference.used == 4


def test_some_bad_fixes_do_not_matter() -> None:
    """Zeros, another hemisphere, a jump of 50 m: an eighth of all each."""
    sequence = recording(0.3)
    places = sequence.gnss.lat_lon_alt.copy()
    places[::8] = 0
    places[1::8, 0] *= -1
    places[25:50, 1] += 7e-4
    found = fit(replace(sequence, gnss=replace(sequence.gnss, lat_lon_alt=places))).georeference
    own = np.stack([r.T_world_lidar[:3, 3] for r in RESULTS])
    off = error_on_earth(found, own, POSES[:, :3, 3])
    assert np.sqrt((off[:, :2] ** 2).sum(1).mean()) < 0.3
    assert found.used < 0.7 * found.fixes


def test_a_recording_without_fixes_is_reported_before_the_run() -> None:
    with pytest.raises(InputError, match="--georeference"):
        require_gnss(replace(recording(0.1), gnss=None), GnssConfig(mode="fit"))
    require_gnss(replace(recording(0.1), gnss=None), GnssConfig())


@pytest.mark.parametrize(
    ("code", "why"), [(4326, "does not count in metres on a plane"), (29999, "PROJ knows no such")]
)
def test_coordinates_of_no_map_are_refused_before_the_run(code: int, why: str) -> None:
    with pytest.raises(UsageError, match=why):
        require_gnss(recording(0.1), GnssConfig(mode="graph", crs=code))
    require_gnss(recording(0.1), GnssConfig(crs=code))
    require_gnss(recording(0.1), GnssConfig(mode="graph", crs=25832))


def moved(which: np.ndarray, metres: float, noise: float = 0.85) -> Stub:
    """A fix a second with some of them so far north, and noise of the stated sigma."""
    stub = recording(noise)
    assert stub.gnss is not None
    every = slice(None, None, 5)
    fixes = stub.gnss.lat_lon_alt[every].copy()
    fixes[which, 0] += metres / 111_200
    stub.gnss = GnssStream(stub.gnss.stamps_ns[every], fixes, stub.gnss.sigma[every])
    return stub


@pytest.mark.parametrize("which", [[3], [2, 5, 8], [20, 21, 22], [0, 39], [0, 1, 39]])
def test_fixes_that_odometry_contradicts_are_counted_and_reported(which: list[int]) -> None:
    placed = fit(moved(np.array(which), 100.0))
    assert placed.georeference is not None
    assert placed.georeference.used == 40 - len(which)
    match = re.search(rf"odometry contradicts {len(which)} of 40 fixes, the farthest by ([0-9.]+) m", placed.problem)
    assert match is not None, placed.problem
    assert float(match.group(1)) == pytest.approx(100.0, abs=4.0)


@pytest.mark.parametrize(("first", "may_be_right"), [(20, True), (26, False)])
def test_a_jump_of_all_fixes_is_reported_with_its_size_and_time(first: int, may_be_right: bool) -> None:
    problem = fit(moved(np.arange(first, 40), 100.0)).problem
    match = re.search(rf"all fixes jump by ([0-9.]+) m together {first}.0 s after the first", problem)
    assert match is not None, problem
    assert float(match.group(1)) == pytest.approx(100.0, abs=2.0)
    assert ("may as well be the right ones" in problem) == may_be_right
    before = fit(moved(np.arange(10), 30.0)).problem
    assert "together 10.0 s after the first" in before
    assert "the 10 of 40 before are left out" in before


@pytest.mark.parametrize("seed", range(20))
def test_fixes_that_scatter_as_they_state_are_no_problem(seed: int) -> None:
    assert fit(recording(0.85, seed)).problem == ""
