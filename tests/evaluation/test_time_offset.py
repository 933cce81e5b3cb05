"""The time offset at which an estimate fits its truth best, on drives whose offset is known; five seeds each."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cli.calling import lslam

from lslam.core.config.outputs import EvalConfig
from lslam.core.geometry import se3, so3
from lslam.core.geometry.se3 import poses_at
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate
from lslam.evaluation.time_offset import fit_offset
from lslam.io.formats.trajectory_lines import write_tum

SCANS, STEP_NS = 300, 100_000_000
Floats = np.ndarray


def motion(kind: str, t: Floats, rng: np.random.Generator) -> Floats:
    """Poses (N, 4, 4) at times t (N,), s: a walk that sways, a car on bends, a straight road, a tripod."""
    phase = rng.uniform(0, 6, 6)
    sway = np.zeros((len(t), 2))
    speed, yaw = 10 + 0 * t, 0 * t
    if kind == "walk":
        yaw = 0.4 * np.sin(0.35 * t + phase[0]) + 0.3 * np.sin(0.9 * t + phase[1])
        speed = 1.3 + 0.15 * np.sin(0.7 * t + phase[2])
        sway = np.stack([0.04 * np.sin(6 * t + phase[3]), 0.03 * np.sin(5 * t + phase[4])], axis=1)
    if kind == "car":
        yaw, speed = 0.8 * np.tanh(4 * np.sin(0.15 * t + phase[0])), 8 + 4 * np.sin(0.2 * t + phase[1])
    if kind == "tripod":
        speed = 0 * t
    p = np.cumsum(np.stack([speed * np.cos(yaw), speed * np.sin(yaw), 0 * t], axis=1) * np.gradient(t)[:, None], axis=0)
    return se3.make(so3.from_euler_rpy(np.column_stack([sway, yaw])), p)


def pair(
    kind: str, offset_s: float, rate_hz: int, seed: int, has_rotations: bool = True
) -> tuple[Trajectory, Trajectory]:
    """An odometry of 10 Hz that drifts and whose stamps come `offset_s` too early, and its truth with noise of its own."""
    rng = np.random.default_rng(seed)
    t = np.arange(-1, SCANS * 0.1 + 1, 0.005)
    exact, at = motion(kind, t, rng), np.rint(t * 1e9).astype(np.int64)
    stamps = np.arange(SCANS) * STEP_NS
    own = poses_at(at, exact, stamps + round(offset_s * 1e9))
    twist = np.hstack([rng.normal(0, 0.01, (SCANS - 1, 3)), rng.normal(0, 0.001, (SCANS - 1, 3))])
    drifting = [own[0]]
    for step in se3.relative(own[:-1], own[1:]) @ se3.exp(twist):
        drifting.append(drifting[-1] @ step)
    true_stamps = np.arange(0, SCANS * STEP_NS, 10**9 // rate_hz)
    noise = np.hstack([rng.normal(0, 0.003, (len(true_stamps), 3)), rng.normal(0, 0.0005, (len(true_stamps), 3))])
    truth = poses_at(at, exact, true_stamps) @ se3.exp(noise)
    return Trajectory(stamps, np.array(drifting)), Trajectory(true_stamps, truth, has_rotations=has_rotations)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("rate_hz", [10, 100])
@pytest.mark.parametrize(
    ("kind", "offset_s", "within_s"),
    [("walk", 0.05, 0.005), ("walk", 0.1, 0.005), ("walk", -0.037, 0.005), ("car", 0.1, 0.04), ("car", -0.1, 0.04)],
)
def test_an_offset_is_clear_and_right(kind: str, within_s: float, offset_s: float, rate_hz: int, seed: int) -> None:
    fit = fit_offset(*pair(kind, offset_s, rate_hz, seed))
    assert fit is not None
    assert fit.is_clearly_off()
    assert fit.offset_ns / 1e9 == pytest.approx(offset_s, abs=within_s)
    assert fit.coherence > 0.7, "far from the least that counts"


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("rate_hz", [10, 100])
@pytest.mark.parametrize(("kind", "offset_s"), [("walk", 0.0), ("car", 0.0), ("straight", 0.05), ("tripod", 0.05)])
def test_nothing_is_clear_where_there_is_none_or_motion_does_not_tell(
    kind: str, offset_s: float, rate_hz: int, seed: int
) -> None:
    for has_rotations in (True, False):
        fit = fit_offset(*pair(kind, offset_s, rate_hz, seed, has_rotations))
        assert fit is None or not fit.is_clearly_off()


@pytest.mark.parametrize("seed", range(5))
def test_a_short_walk_is_enough(seed: int) -> None:
    estimate, truth = pair("walk", 0.1, 10, seed)
    fit = fit_offset(estimate.select(slice(60)), truth.select(slice(60)))
    assert fit is not None
    assert fit.is_clearly_off()
    assert fit.offset_ns / 1e9 == pytest.approx(0.1, abs=0.02)
    right, truth = pair("walk", 0.0, 10, seed)
    fit = fit_offset(right.select(slice(60)), truth.select(slice(60)))
    assert fit is None or not fit.is_clearly_off()


def test_positions_alone_tell_by_their_speed() -> None:
    fits = [fit_offset(*pair("car", 0.1, 100, seed, has_rotations=False)) for seed in range(5)]
    assert [fit is not None and abs(fit.offset_ns / 1e9 - 0.1) < 6 * fit.sigma_ns / 1e9 for fit in fits] == [True] * 5
    assert sum(fit is not None and fit.is_clearly_off() for fit in fits) >= 4


@pytest.mark.parametrize("rate_hz", [10, 100])
def test_the_note_names_what_auto_takes(rate_hz: int) -> None:
    estimate, truth = pair("walk", 0.05, rate_hz, 1)
    as_is = evaluate(estimate, truth)
    (note,) = [note for note in as_is.notes if "fits best with +0.0" in note]
    assert "--time-offset auto takes it" in note
    auto = evaluate(estimate, truth, EvalConfig(time_offset="auto"))
    assert auto.time_offset == pytest.approx(0.05, abs=0.005)
    assert auto.matched >= SCANS - 2
    by_number = evaluate(estimate, truth, EvalConfig(time_offset=0.05))
    assert by_number.matched >= SCANS - 2
    for moved in (auto, by_number):
        assert not any("fits best" in note for note in moved.notes)
        better, worse = moved.rpe[0].rotation_deg, as_is.rpe[0].rotation_deg
        assert better is not None
        assert worse is not None
        assert better.rmse < 0.8 * worse.rmse, "drift hides the offset in positions, not in turns from scan to scan"


def test_right_stamps_get_no_note() -> None:
    for kind in ("walk", "car", "straight"):
        assert not any("fits best" in note for note in evaluate(*pair(kind, 0.0, 100, 2)).notes)


def test_the_command_takes_auto_and_a_number(tmp_path: Path) -> None:
    estimate, truth = pair("walk", 0.1, 10, 3)
    write_tum(tmp_path / "est.tum", estimate)
    write_tum(tmp_path / "gt.tum", truth)
    rmse = {}
    for word in ("0", "auto", "0.1"):
        done = lslam("eval", "est.tum", "gt.tum", "--json", "--time-offset", word, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        document = json.loads(done.stdout)
        rmse[word] = document["rpe"][0]["rotation_deg"]["rmse"]
        if word == "auto":
            assert document["association"]["time_offset_s"] == pytest.approx(0.1, abs=0.005)
    assert rmse["auto"] < 0.8 * rmse["0"]
    assert rmse["auto"] == pytest.approx(rmse["0.1"], rel=0.05)
