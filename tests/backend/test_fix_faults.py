"""Faults of a whole receiver are set right and said: the run is no worse than odometry."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from stub_sequences import Stub

from lslam.backend.georeferencing import Placement, place
from lslam.backend.graph.fix_errors import NO_HEIGHT
from lslam.backend.graph.odometry_constraints import odometry_constraints
from lslam.backend.graph.problem import PoseGraph
from lslam.core.config import Config
from lslam.core.geometry import geodesy, se3, so3
from lslam.core.types.gnss import GnssStream
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Calibration
from lslam.core.types.trajectory import Keyframe

ORIGIN = np.array([49.0, 8.4, 115.0])
COUNT = 400
SECONDS = 0.1 * np.arange(COUNT)
STAMPS = np.arange(COUNT, dtype=np.int64) * 100_000_000


def at(seconds: np.ndarray) -> np.ndarray:
    """(N, 4, 4) of a drive that slows down, hurries and turns."""
    x, y = 40 * np.sin(seconds / 9) + 10 * np.sin(seconds / 3), 25 * np.sin(seconds / 5)
    heading = np.arctan2(5 * np.cos(seconds / 5), 40 / 9 * np.cos(seconds / 9) + 10 / 3 * np.cos(seconds / 3))
    R = so3.from_euler_rpy(np.column_stack([0 * heading, 0 * heading, heading]))
    return se3.make(R, np.column_stack([x, y, 0 * x]))


POSES = at(SECONDS)
RESULTS = [ScanResult(i, int(STAMPS[i]), T) for i, T in enumerate(se3.inverse(POSES[0]) @ POSES)]
KEYFRAMES = [Keyframe(n, i, int(STAMPS[i]), RESULTS[i].T_world_lidar) for n, i in enumerate(range(0, COUNT, 10))]


def wandering(count: int, memory: float, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) errors of variance 1, mostly a Gauss-Markov process of time constant `memory`, s, at 5 Hz."""
    slow, lasting = rng.normal(size=(count, 3)), np.exp(-0.2 / memory)
    for i in range(1, count):
        slow[i] = lasting * slow[i - 1] + np.sqrt(1 - lasting**2) * slow[i]
    return np.asarray(0.94 * slow + 0.35 * rng.normal(size=(count, 3)))


def placed(
    late: float = 0.0, noise: float = 0.5, stated: float | list[float] = 0.5, climb: float = 0.0, seed: int = 0,
    memory: float = 0.0, run_off: float = 0.0,
) -> Placement:  # fmt: skip
    """By 5 fixes a second, of which those of the last 15 s are higher by `climb`, m.

    memory : s, of errors that are correlated; run_off : m/m by which odometry drifts, which states a millimetre after a metre
    """
    taken = SECONDS[2:-2:2]
    rng = np.random.default_rng(seed)
    error = noise * (wandering(len(taken), memory, rng) if memory else rng.normal(size=(len(taken), 3))) * [1, 1, 1.8]
    error[taken > 25, 2] += climb
    fixes = geodesy.from_local(at(taken)[:, :3, 3] + error, ORIGIN)
    stream = GnssStream(np.round(1e9 * (taken + late)).astype(np.int64), fixes, np.resize(stated, len(taken)))
    config = Config.model_validate({"gnss": {"mode": "graph"}})
    results = drifting(run_off) if memory else RESULTS
    keyframes = [replace(k, T_world_lidar=results[k.scan].T_world_lidar) for k in KEYFRAMES]
    graph = PoseGraph(
        np.stack([k.T_world_lidar for k in keyframes]), odometry_constraints(keyframes, results, config.graph)
    )
    sequence = Stub(["none"] * COUNT, calibration=Calibration(T_lidar_gnss=np.eye(4)), gnss=stream)
    return place(sequence, results, keyframes, None, graph, config)


def drifting(run_off: float) -> list[ScanResult]:
    """Odometry that runs off ahead and to the left by `run_off` m/m, and states a millimetre after a metre."""
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(POSES[:, :3, 3], axis=0), axis=1)))
    out = []
    for result, m in zip(RESULTS, way.tolist(), strict=True):
        T = result.T_world_lidar.copy()
        T[:2, 3] += run_off * m
        out.append(replace(result, T_world_lidar=T, covariance=m * np.diag([1e-6] * 3 + [1e-9] * 3)))
    return out


def apart(found: Placement) -> np.ndarray:
    """(N, 3) m, of the trajectory from where it is on the Earth."""
    assert found.georeference is not None
    world = se3.apply(found.georeference.T_enu_world, np.stack([r.T_world_lidar[:3, 3] for r in RESULTS]))
    return geodesy.to_local(geodesy.from_local(world, found.georeference.origin), ORIGIN) - POSES[:, :3, 3]


@pytest.mark.parametrize("seed", range(5))
def test_sound_fixes_have_no_faults(seed: int) -> None:
    for noise in (0.02, 0.5, 2.0):
        found = placed(noise=noise, stated=noise, seed=seed)
        assert (found.faults.problems, found.problem) == ((), "")
        assert len(found.fixes) == 198


@pytest.mark.parametrize("seed", range(5))
def test_sigmas_that_are_far_too_small_are_those_of_the_scatter(seed: int) -> None:
    found = placed(stated=0.02, seed=seed)
    assert len(found.faults.problems) == 1
    assert found.faults.problems[0].startswith(
        "GNSS: fixes state 0.02, 0.02 and 0.04 m (east, north, up) and scatter by 0."
    )
    sigmas = np.median([fix.sigma for fix in found.fixes], axis=0)
    np.testing.assert_allclose(sigmas, [0.5, 0.5, 0.9], rtol=0.35)
    assert found.walk == 0.0
    assert len(found.fixes) == 198
    assert np.abs(apart(found)[:, :2]).max() < 0.3


@pytest.mark.parametrize("seed", range(5))
def test_some_sigmas_that_are_far_too_small_are_judged_beside_those_of_other_fixes(seed: int) -> None:
    """A receiver that takes some of its solutions for fixed."""
    found = placed(stated=[0.02, 5.0], seed=seed)
    (problem,) = found.faults.problems
    assert problem.startswith("GNSS: 99 of 198 fixes state 0.02, 0.02 and 0.04 m (east, north, up) and scatter by 0.")
    sigmas = np.array([fix.sigma for fix in found.fixes])
    np.testing.assert_allclose(np.median(sigmas[0::2], axis=0), [0.5, 0.5, 0.9], rtol=0.35)
    np.testing.assert_allclose(sigmas[1::2], np.tile([5.0, 5.0, 9.0], (99, 1)), rtol=0.01)
    assert np.abs(apart(found)[:, :2]).max() < 0.4


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("late", [2.0, -1.0])
def test_stamps_that_are_late_are_set_right(late: float, seed: int) -> None:
    found = placed(late=late, seed=seed)
    assert len(found.faults.problems) == 1
    assert f"{'late' if late > 0 else 'early'} (one sigma" in found.faults.problems[0]
    assert found.faults.facts is not None
    assert found.faults.facts["fixes_late"]["seconds"] == pytest.approx(late, abs=0.2)
    assert np.abs(apart(found)[:, :2]).max() < 0.5


@pytest.mark.parametrize("seed", range(5))
def test_heights_of_another_datum_do_not_cost_east_and_north(seed: int) -> None:
    found = placed(climb=-48.0, seed=seed)
    assert len(found.faults.problems) == 1
    said = found.faults.problems[0]
    assert "below the others, from 25.0 s after the first" in said or "below the others, from 24.8" in said
    assert found.faults.facts == {"heights_left_out": 73}
    assert len(found.fixes) == 198
    heights = np.array([fix.sigma[2] < NO_HEIGHT for fix in found.fixes])
    assert heights.sum() == 125
    assert np.abs(apart(found)[:, :2]).max() < 0.3
    # Half of the heights leave the tilt less sure.
    assert np.abs(apart(found)[:, 2]).max() < 3.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("climb", [6.0, -6.0])
def test_heights_that_jump_by_less_than_a_tilt_makes_are_named(climb: float, seed: int) -> None:
    found = placed(climb=climb, seed=seed)
    assert found.faults.facts is not None
    assert found.faults.facts["heights_left_out"] == pytest.approx(73, abs=2)
    said = re.search(r"fixes are (\d\.\d) m (above|below) the others, from (\d+\.\d) s", found.faults.problems[0])
    assert said is not None
    assert float(said[1]) == pytest.approx(6.0, abs=1.0)
    assert said[2] == ("above" if climb > 0 else "below")
    assert float(said[3]) == pytest.approx(24.9, abs=0.5)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("noise", "memory"), [(0.5, 20.0), (2.0, 100.0)])
def test_wandering_fixes_that_state_too_little_are_no_drift_of_odometry(noise: float, memory: float, seed: int) -> None:
    found = placed(noise=noise, stated=0.02, memory=memory, seed=seed)
    assert found.faults.problems
    assert found.walk == 0.0
    assert found.fix_noise is not None
    assert found.fix_noise.sigma[0] > 0.2 * noise


@pytest.mark.parametrize("seed", range(2))
def test_odometry_that_runs_off_farther_than_fixes_wander_drifts_all_the_same(seed: int) -> None:
    """By 20 m over a way of 290 m, beside fixes of half a metre."""
    found = placed(stated=0.02, memory=20.0, run_off=0.05, seed=seed)
    assert found.walk > 1.0
