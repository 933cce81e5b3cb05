"""Odometry that ran away, made consistent: what is repaired, what is refused, and what is left alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2
from stub_sequences import Stub

from lslam.backend import optimise
from lslam.backend.added_drift import with_drift
from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.optimise import run_back_end
from lslam.backend.outcome import BackEnd
from lslam.core.config import Config, load_config
from lslam.core.geometry import geodesy, se3, so3
from lslam.core.geometry.noise import RIGHT_PROBABILITY
from lslam.core.geometry.se3 import umeyama
from lslam.core.types.constraint import Constraint, LoopCandidate
from lslam.core.types.gnss import GnssStream
from lslam.core.types.imu import GravityDirection, ImuDiagnostics
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Calibration
from lslam.core.types.trajectory import Keyframe
from lslam.io.formats.trajectory_lines import write_g2o

# Two laps of 400 m, a scan each metre, a keyframe every other scan.
Floats = NDArray[np.float64]

COUNT, LAP, EVERY = 800, 400, 2
PHASE = 2 * np.pi * np.arange(COUNT) / LAP
RADIUS = LAP / (2 * np.pi)
CITY = se3.make(
    so3.from_euler_rpy(np.column_stack([0 * PHASE, 0 * PHASE, PHASE + 0.5 * np.pi])),
    np.column_stack([RADIUS * np.cos(PHASE), RADIUS * np.sin(PHASE), 2 * np.sin(PHASE)]),
)
REAL = se3.inverse(CITY[0]) @ CITY
ORIGIN, ARM = np.array([49.0, 8.4, 115.0]), np.array([-0.9, 0.0, 0.5])
OWN = np.diag([1e-4] * 3 + [1e-8] * 3)


def config(*settings: str) -> Config:
    return load_config(settings=settings, environ={})


def drifted(*settings: str, tilt_deg_per_100m: float = 0.0) -> list[ScanResult]:
    results = [
        ScanResult(i, i * 100_000_000, T, covariance=OWN * (1 + i), registration_covariance=OWN)
        for i, T in enumerate(REAL)
    ]
    return with_drift(results, config(*settings).debug, tilt_deg_per_100m)


def store_of(results: list[ScanResult], seen: Floats | None = None) -> KeyframeStore:
    """Keyframes of one in `EVERY` scans; `seen` (N, 3) are points of the world that all of them see."""
    store = KeyframeStore()
    for n, i in enumerate(range(0, len(results), EVERY)):
        keyframe = Keyframe(n, i, results[i].stamp_ns, results[i].T_world_lidar, results[i].covariance, float(i))
        own = np.zeros((1, 3)) if seen is None else se3.apply(se3.inverse(results[i].T_world_lidar), seen)
        store.add(keyframe, own.astype(np.float32))
    return store


def candidate(a: int, b: int, off: float = 0.0, seed: int = 0) -> LoopCandidate:
    """Keyframe b seen from a to a centimetre, or wrong by `off` metres."""
    d = np.random.default_rng([seed, a, b]).normal(size=6) * [0.01, 0.01, 0.01, 5e-4, 5e-4, 5e-4]
    T = se3.exp(d) @ se3.relative(REAL[a * EVERY], REAL[b * EVERY])
    T[0, 3] += off
    S = np.diag([1e-4] * 3 + [2.5e-7] * 3)
    return LoopCandidate(a, b, 0.0, 0.1, "accepted", "agreement", "", 0.05, 0.9, Constraint(a, b, T, S))


LOOPS = [candidate(a, a + LAP // EVERY) for a in range(5, 190, 20)]


def error(done: BackEnd, real: np.ndarray = REAL) -> float:
    p = np.stack([r.T_world_lidar[:3, 3] for r in done.results])
    return float(np.sqrt(((p - real[:, :3, 3]) ** 2).sum(1).mean()))


def tilt(done: BackEnd) -> float:
    """The largest, rad, against the truth."""
    turned = [r.T_world_lidar[2, :3] @ T[2, :3] for r, T in zip(done.results, REAL, strict=True)]
    return float(np.arccos(np.clip(turned, -1, 1)).max())


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_loops_take_the_drift_away(seed: int) -> None:
    results = drifted(f"debug.drift_seed={seed}")
    done = run_back_end(Stub([]), results, store_of(results), config(), LOOPS)
    assert error(done) < 0.3 * error(BackEnd(results))
    assert done.facts["loops"] == len(LOOPS)
    assert done.problems == []
    # Loops and what odometry knows are both in the graph that is written.
    assert len(done.constraints) == len(LOOPS) + COUNT // EVERY - 1
    for result in done.results[::50]:
        assert np.linalg.eigvalsh(result.covariance).min() > 0


def test_by_the_identity_every_constraint_has_the_same_covariance() -> None:
    done = run_back_end(Stub([]), drifted(), store_of(drifted()), config("graph.information=identity"), LOOPS)
    assert np.array([c.covariance for c in done.constraints]) == pytest.approx(np.array([np.eye(6)] * 409))


def test_a_constant_drift_is_corrected_and_reported() -> None:
    results = drifted()
    done = run_back_end(Stub([]), results, store_of(results), config(), LOOPS)
    plain = run_back_end(Stub([]), results, store_of(results), config("graph.steady_drift=false"), LOOPS)
    assert error(done) < 0.8 * error(plain)
    assert "steady_drift" not in plain.facts
    told = done.facts["steady_drift"]
    shift = np.array([told[f"{axis}_percent"]["estimate"] for axis in "xyz"])
    assert np.linalg.norm(shift) == pytest.approx(1.0, abs=0.1)
    assert abs(told["left_deg_per_100m"]["estimate"]) == pytest.approx(0.5, abs=0.05)
    assert told["log_likelihood_gain"] > told["gain_by_chance"]
    assert told["gain_by_chance"] == pytest.approx(0.5 * chi2.ppf(RIGHT_PROBABILITY, 6), abs=0.06)
    # The odometry that is written is the one that was solved.
    steps = [c for c in done.constraints if c.b == c.a + 1]
    ends = [se3.relative(done.keyframes[c.a], done.keyframes[c.b]) for c in steps]
    assert max(np.linalg.norm(T[:3, 3] - c.T_a_b[:3, 3]) for T, c in zip(ends, steps, strict=True)) < 0.012


def test_without_drift_nothing_is_set_right() -> None:
    results = drifted("debug.drift_percent=0", "debug.drift_deg_per_100m=0")
    dones = [
        run_back_end(Stub([]), results, store_of(results), config(*words), LOOPS)
        for words in ((), ("graph.steady_drift=false",))
    ]
    assert "steady_drift" not in dones[0].facts
    for a, b in zip(*(done.results for done in dones), strict=True):
        np.testing.assert_array_equal(a.T_world_lidar, b.T_world_lidar)


def test_wrong_loops_are_rejected_with_a_reason() -> None:
    results = drifted()
    wrong = [candidate(a, a + 160, off=15.0) for a in (10, 60, 110, 160)]
    mixed = sorted([*LOOPS, *wrong], key=lambda c: c.b)
    done = run_back_end(Stub([]), results, store_of(results), config(), mixed)
    assert error(done) < 1.2 * error(run_back_end(Stub([]), results, store_of(results), config(), LOOPS))
    refused = [c for c in done.candidates if c.verdict == "rejected"]
    assert [(c.a, c.b) for c in refused] == [(c.a, c.b) for c in sorted(wrong, key=lambda c: c.b)]
    assert all(c.reason and c.stage in ("consistency", "graph") for c in refused)


@pytest.mark.parametrize("loops", ["none", "rejected", "refused"])
def test_without_an_accepted_loop_closure_nothing_moves(loops: str) -> None:
    results = drifted()
    given = {
        "none": [],
        "rejected": [replace(c, verdict="rejected") for c in LOOPS],
        "refused": [candidate(10, 170, off=60.0)],
    }[loops]
    done = run_back_end(Stub([]), results, store_of(results), config(), given)
    assert done.results is results
    assert not done.is_optimised
    assert all(c.verdict == "rejected" for c in done.candidates)


def test_a_graph_that_cannot_be_solved_leaves_odometry(monkeypatch: pytest.MonkeyPatch) -> None:
    results = drifted()
    lost = optimise.odometry_constraints
    monkeypatch.setattr(optimise, "odometry_constraints", lambda *given: lost(*given)[:50])
    done = run_back_end(Stub([]), results, store_of(results), config(), LOOPS)
    assert done.results is results
    assert "in pieces" in done.problems[0]
    assert {(c.verdict, c.stage, c.reason) for c in done.candidates} == {
        ("rejected", "graph", "the pose graph could not be solved")
    }


def test_odometry_with_zero_covariance_can_be_written(tmp_path: Path) -> None:
    """Covariances that do not grow say that nothing was added on the way: information without end."""
    results = [replace(r, covariance=OWN) for r in drifted()]
    done = run_back_end(Stub([]), results, store_of(results), config(), LOOPS)
    assert done.is_optimised
    write_g2o(tmp_path / "graph.g2o", done.keyframes, done.constraints)
    edges = [line.split() for line in (tmp_path / "graph.g2o").read_text().splitlines() if line.startswith("EDGE")]
    assert len(edges) == COUNT // EVERY - 1 + len(LOOPS)
    assert np.isfinite(np.array([edge[3:] for edge in edges], float)).all()


def test_one_keyframe_is_no_graph() -> None:
    results = drifted()[:1]
    store = KeyframeStore()
    store.add(Keyframe(0, 0, 0, np.eye(4)), np.zeros((1, 3), np.float32))
    assert run_back_end(Stub([]), results, store, config(), []).results is results
    assert run_back_end(Stub([]), results, store, config("gnss.mode=fit"), []).problems


def recording(noise: float = 1.0, outage: tuple[int, int] = (300, 500), seed: int = 0) -> Stub:
    """A fix every fifth scan, none between the scans of the outage."""
    scans = np.array([i for i in range(0, COUNT - 1, 5) if not outage[0] <= i < outage[1]])
    antenna = (CITY[scans] @ se3.make(np.eye(3), ARM))[:, :3, 3]
    antenna = antenna + noise * np.random.default_rng(seed).normal(size=antenna.shape) * [1, 1, 1.8]
    stream = GnssStream(scans * 100_000_000, geodesy.from_local(antenna, ORIGIN), np.full(len(scans), max(noise, 0.05)))
    return Stub(["none"] * COUNT, calibration=Calibration(T_lidar_gnss=se3.make(np.eye(3), ARM)), gnss=stream)


def on_earth(done: BackEnd) -> np.ndarray:
    """(N, 3) m, of the results in the frame of the city, through lat, lon and height."""
    place = done.georeference
    p = np.stack([r.T_world_lidar[:3, 3] for r in done.results])
    return geodesy.to_local(geodesy.from_local(se3.apply(place.T_enu_world, p), place.origin), ORIGIN)


@pytest.mark.parametrize("loops", [[], LOOPS])
def test_fixes_of_a_metre_bound_the_error_through_an_outage(loops: list[LoopCandidate]) -> None:
    """200 m without fixes, drift of 0.5 %: horizontally within half a metre of the Earth's truth."""
    results = drifted("debug.drift_percent=0.5", "debug.drift_deg_per_100m=0.25")
    done = run_back_end(recording(), results, store_of(results), config("gnss.mode=graph"), loops)
    assert done.georeference.method == "graph"
    assert ("steady_drift" in done.facts) == bool(loops), "only loops tell it"
    off = (on_earth(done) - CITY[:, :3, 3])[:, :2]
    assert np.sqrt((off**2).sum(1).mean()) < 0.5
    before = (on_earth(run_back_end(recording(), results, store_of(results), config("gnss.mode=fit"), []))) - CITY[
        :, :3, 3
    ]
    assert np.sqrt((off**2).sum(1).mean()) < 0.7 * np.sqrt((before[:, :2] ** 2).sum(1).mean())


def test_a_constant_drift_is_corrected_before_fixes_are_used() -> None:
    """Loops know its rate to a part of what fixes of a metre know: the shape is theirs, the place on the Earth the fixes'."""
    results = drifted()
    shapes = []
    for words in ((), ("gnss.mode=graph",)):
        done = run_back_end(recording(), results, store_of(results), config(*words), LOOPS)
        assert "steady_drift" in done.facts
        p = np.stack([r.T_world_lidar[:3, 3] for r in done.results])
        off = se3.apply(umeyama(p, CITY[:, :3, 3])[0], p) - CITY[:, :3, 3]
        shapes.append(float(np.sqrt((off**2).sum(1).mean())))
    assert shapes[1] < 1.3 * shapes[0]
    assert done.georeference.used >= done.georeference.fixes - 2
    away = (on_earth(done) - CITY[:, :3, 3])[:, :2]
    assert np.sqrt((away**2).sum(1).mean()) < 0.5


def test_what_fixes_bend_in_hdl_depends_on_how_the_clouds_of_keyframes_fit() -> None:
    """It claims 0.1 m from one keyframe to the next where these fit to a point, and metres where they do not."""
    results = drifted("debug.drift_percent=0", "debug.drift_deg_per_100m=0")[:150]
    landmarks = np.random.default_rng(0).uniform(-30, 30, (40, 3)) + REAL[0, :3, 3]
    bent = []
    for store, words in (
        (store_of(results, landmarks), ()),
        (store_of(results, landmarks), ("gnss.sigma=1",)),
        (store_of(results), ()),
    ):
        given = config("odometry.preset=hdl", "graph.floor=false", "gnss.mode=graph", *words)
        done = run_back_end(recording(), results, store, given, [])
        p, real = np.stack([r.T_world_lidar[:3, 3] for r in done.results]), REAL[:150, :3, 3]
        off = se3.apply(umeyama(p, real)[0], p) - real
        bent.append(float(np.sqrt((off**2).sum(1).mean())))
    assert bent[0] < 0.15
    assert bent[0] < 0.6 * bent[1]
    assert bent[2] > 4 * bent[0]


def test_georeferencing_only_leaves_the_trajectory_alone() -> None:
    results = drifted("debug.drift_percent=0.05", "debug.drift_deg_per_100m=0.02")
    done = run_back_end(recording(), results, store_of(results), config("gnss.mode=fit", "gnss.crs=25832"), [])
    assert done.results is results
    assert (done.georeference.method, done.georeference.epsg) == ("fit", 25832)
    off = (on_earth(done) - CITY[:, :3, 3])[:, :2]
    assert np.sqrt((off**2).sum(1).mean()) < 0.5


def test_fixes_that_are_all_bad_leave_odometry_and_its_loops() -> None:
    sequence = recording()
    places = sequence.gnss.lat_lon_alt.copy()
    places[:, 0] *= -1
    south = replace(sequence, gnss=replace(sequence.gnss, lat_lon_alt=places))
    results = drifted()
    alone = run_back_end(south, results, store_of(results), config("gnss.mode=graph"), [])
    assert alone.results is results
    assert "rejected" in alone.problems[0]
    closed = run_back_end(south, results, store_of(results), config("gnss.mode=graph"), LOOPS)
    assert error(closed) < 0.3 * error(BackEnd(results))
    assert closed.georeference is None


@pytest.mark.parametrize("mode", ["graph", "fit"])
@pytest.mark.parametrize("axis", [0, 1])
def test_fixes_with_a_wrong_sign_are_reported_and_left_out(axis: int, mode: str) -> None:
    """A third of them in another hemisphere: the others place the run; nearly all: they are a mirror image, and none does."""
    sequence = recording(0.5)
    results = drifted("debug.drift_percent=0.2", "debug.drift_deg_per_100m=0.1")
    count = len(sequence.gnss)
    for share in (0.3, 0.9):
        flipped = np.random.default_rng(axis).permutation(count) < round(share * count)
        places = sequence.gnss.lat_lon_alt.copy()
        places[flipped, axis] *= -1
        lost = replace(sequence, gnss=replace(sequence.gnss, lat_lon_alt=places))
        done = run_back_end(lost, results, store_of(results), config(f"gnss.mode={mode}"), [])
        if share < 0.5:
            assert f"{flipped.sum()} of {count} fixes lie more than 100 km from the others" in done.problems[0]
            assert done.georeference.used <= count - flipped.sum()
            off = (on_earth(done) - CITY[:, :3, 3])[:, :2]
            assert np.sqrt((off**2).sum(1).mean()) < 0.5
        else:
            assert done.results is results
            assert done.georeference is None
            assert "all rejected" in done.problems[0]


def test_a_receiver_that_jumps_is_left_out_where_it_does() -> None:
    sequence = recording(0.5)
    places = sequence.gnss.lat_lon_alt.copy()
    places[30:50, 1] += 4e-4  # 29 m
    results = drifted("debug.drift_percent=0.2", "debug.drift_deg_per_100m=0.1")
    jumped = replace(sequence, gnss=replace(sequence.gnss, lat_lon_alt=places))
    done = run_back_end(jumped, results, store_of(results), config("gnss.mode=graph"), [])
    assert done.georeference.used <= done.georeference.fixes - 20
    off = (on_earth(done) - CITY[:, :3, 3])[:, :2]
    assert np.sqrt((off**2).sum(1).mean()) < 0.5


def test_gravity_keeps_it_level_beside_loops() -> None:
    """A roll that grows to 4 deg: the few loops of one place cannot tell where it came from, the IMU can."""
    roll = np.deg2rad(4) * np.arange(COUNT) / COUNT
    rolled = REAL @ se3.make(so3.exp(np.column_stack([roll, 0 * roll, 0 * roll])), np.zeros((COUNT, 3)))
    down = -REAL[:, 2, :3]
    results = [
        ScanResult(i, i * 100_000_000, rolled[i], covariance=OWN * (1 + i), registration_covariance=OWN,
                   imu=ImuDiagnostics(gravity=GravityDirection(down[i], 0.003)))
        for i in range(COUNT)
    ]  # fmt: skip
    done = run_back_end(Stub([]), results, store_of(results), config(), LOOPS[:1])
    blind = run_back_end(Stub([]), results, store_of(results), config("graph.gravity_deg=0"), LOOPS[:1])

    assert tilt(done) < 0.6 * tilt(blind)
    # The start stays where it was: the world's up is found, not forced on it.
    np.testing.assert_allclose(done.results[0].T_world_lidar, results[0].T_world_lidar, atol=1e-9)


def with_gravity(results: list[ScanResult], seed: int, sigma: float = np.deg2rad(0.3)) -> list[ScanResult]:
    """Down as an IMU measures it there, wrong by `sigma` rad, alike over twenty seconds."""
    rng = np.random.default_rng([seed, 5])
    keep = np.exp(-0.1 / 20.0)
    tilt, out = rng.normal(0, sigma, 3), []
    for result, T in zip(results, REAL, strict=True):
        tilt = keep * tilt + np.sqrt(1 - keep**2) * rng.normal(0, sigma, 3)
        out.append(replace(result, imu=ImuDiagnostics(gravity=GravityDirection(so3.exp(tilt) @ -T[2, :3], sigma))))
    return out


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_gravity_takes_a_tilt_away_without_any_loop(seed: int) -> None:
    """Half a degree per 100 m; the heading, of which gravity knows nothing, is odometry's own."""
    level = ("debug.drift_percent=0", "debug.drift_deg_per_100m=0", f"debug.drift_seed={seed}")
    results = with_gravity(drifted(*level, tilt_deg_per_100m=0.5), seed)
    store = store_of(results)
    done = run_back_end(Stub([]), results, store, config(), [])
    blind = run_back_end(Stub([]), results, store, config("graph.gravity_deg=0"), [])
    assert blind.results is results
    assert tilt(done) < 0.4 * tilt(blind)
    assert error(done) < 0.85 * error(blind)
    assert done.is_optimised
    assert done.facts["drift_factor"] > 0
    yaws = [so3.euler_rpy(d.results[-1].T_world_lidar[:3, :3].T @ REAL[-1, :3, :3])[2] for d in (done, blind)]
    assert abs(yaws[0]) < abs(yaws[1]) + np.deg2rad(0.5)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("count", [COUNT, 300])
def test_gravity_that_is_no_better_than_odometry_moves_nothing(seed: int, count: int) -> None:
    level = ("debug.drift_percent=0", "debug.drift_deg_per_100m=0", f"debug.drift_seed={seed}")
    results = with_gravity(drifted(*level, tilt_deg_per_100m=0.03), seed)[:count]
    store = store_of(results)
    done = run_back_end(Stub([]), results, store, config(), [])
    assert done.results is results
    assert not done.is_optimised


@pytest.mark.parametrize("steepness", [0.0, 0.06])
def test_only_flat_ground_constrains_poses(steepness: float) -> None:
    """A hill under the wheels is said and left out; a flat floor keeps from climbing what drifts upwards."""
    x = 2.0 * np.arange(40)
    pitch = -np.arctan(steepness * np.sin(x / 8))
    z = np.cumsum(2.0 * steepness * np.sin(x / 8)) + 0.005 * x
    poses = se3.make(so3.from_euler_rpy(np.column_stack([0 * x, pitch, 0 * x])), np.column_stack([x, 0 * x, z]))
    results = [
        ScanResult(i, i * 200_000_000, T, covariance=0.01 * OWN * (1 + i), registration_covariance=0.01 * OWN)
        for i, T in enumerate(poses)
    ]
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-15, 15, (3000, 2)), np.full(3000, -1.7)]).astype(np.float32)
    store = KeyframeStore()
    for i, result in enumerate(results):
        store.add(Keyframe(i, i, result.stamp_ns, result.T_world_lidar, result.covariance, float(x[i])), floor)
    done = run_back_end(Stub([]), results, store, config("graph.floor=true", "graph.information=fitness"), [])
    if steepness:
        assert done.results is results
        assert "the ground seen from 40 keyframes is not one plane" in done.problems[0]
    else:
        assert done.problems == []
        assert done.facts["floor_factors"] == 40
        assert abs(done.results[-1].T_world_lidar[2, 3]) < 0.5 * z[-1]
