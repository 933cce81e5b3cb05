"""Ground truth of prisms and antennas: what needs no rotation is scored as evo does, the rest is not available."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cli.calling import lslam

from lslam.core.config.outputs import EvalConfig
from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.formats.trajectory_lines import write_tum

COUNT = 120
NS = 1_700_000_000_000_000_000 + np.arange(COUNT) * 100_000_000


def drive(noise: float = 0.0) -> Trajectory:
    """A bend up a hill; the noise is that of positions, m."""
    t = np.arange(COUNT) * 0.1
    twist = np.stack([0 * t, 0 * t, 0 * t, 0.1 * np.sin(t), 0.05 * np.cos(t), 0.25 * t], axis=1)
    poses = se3.exp(twist)
    poses[:, :3, 3] = np.stack([20 * np.sin(0.25 * t), 20 * (1 - np.cos(0.25 * t)), np.sin(0.5 * t)], axis=1)
    poses[:, :3, 3] += np.random.default_rng(0).normal(0, noise, (COUNT, 3))
    return Trajectory(NS, poses)


def bare(trajectory: Trajectory) -> Trajectory:
    """Positions of the trajectory alone."""
    return Trajectory(trajectory.stamps_ns, se3.make(np.eye(3), trajectory.positions), "unknown", has_rotations=False)


@pytest.mark.parametrize("alignment", ["none", "se3", "sim3", "posyaw"])
def test_errors_of_positions_are_those_with_rotations(alignment: str) -> None:
    config = EvalConfig(align=(alignment,))
    whole, alone = evaluate(drive(0.05), drive(), config), evaluate(drive(0.05), bare(drive()), config)
    assert alone.ate[alignment].translation == whole.ate[alignment].translation
    assert alone.ate[alignment].rotation_deg is None
    assert alone.ate[alignment].horizontal == whole.ate[alignment].horizontal


def test_errors_of_positions_are_those_of_evo() -> None:
    evo = pytest.importorskip("evo.core.trajectory")
    metrics = pytest.importorskip("evo.core.metrics")
    estimate, truth = drive(0.05), drive()
    own = evaluate(estimate, bare(truth), EvalConfig(align=("se3",))).ate["se3"].translation
    wxyz = np.tile([1.0, 0, 0, 0], (COUNT, 1))
    pair = [evo.PosePath3D(t.positions, wxyz) for t in (truth, estimate)]
    pair[1].align(pair[0])
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(tuple(pair))
    assert own is not None
    assert own.rmse == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-9)


@pytest.mark.parametrize("which", ["estimate", "ground truth", "both"])
def test_what_needs_rotations_is_not_available_and_said(which: str) -> None:
    estimate = bare(drive(0.05)) if which != "ground truth" else drive(0.05)
    truth = bare(drive()) if which != "estimate" else drive()
    score = evaluate(estimate, truth, EvalConfig(align=("se3", "origin"), metrics=("thesis",)))
    assert score.ate["se3"].available
    assert not score.ate["origin"].available
    assert [error.n_pairs for error in score.rpe] == [0, 0]
    assert not score.scores["kitti_drift"].available
    who = {"both": "estimate and ground truth have"}.get(which, f"{which} has")
    assert any(note.startswith(f"{who} positions without rotations") for note in score.notes)
    assert not score.faults


def test_a_prism_off_the_lidar_is_scored_at_its_own_place() -> None:
    """A lever arm turns with the body, so that no alignment takes it off."""
    arm = se3.make(np.eye(3), np.array([0.4, -0.3, 0.9]))
    truth = bare(Trajectory(NS, drive().poses @ arm))
    config = EvalConfig(align=("se3",))
    off, carried = (evaluate(drive(), truth, config, T_est_gt=T).ate["se3"].translation for T in (None, arm))
    assert off is not None
    assert carried is not None
    assert off.rmse > 0.1
    assert carried.rmse < 1e-9
    with pytest.raises(InputError, match="both have positions alone"):
        evaluate(bare(drive()), truth, config, T_est_gt=arm)


def test_the_command_scores_a_table_of_positions(tmp_path: Path) -> None:
    write_tum(tmp_path / "est.tum", drive(0.05))
    rows = [
        f"{t // 10**9},{t % 10**9},{x!r},{y!r},{z!r}"
        for t, (x, y, z) in zip(NS.tolist(), drive().positions.tolist(), strict=True)
    ]
    (tmp_path / "prism.csv").write_text("\n".join(["sec,nanosec,x,y,z", *rows]))
    done = lslam("eval", "est.tum", "prism.csv", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    exact = evaluate(read_trajectory(tmp_path / "est.tum"), drive()).ate["se3"].translation
    assert exact is not None
    assert document["ate"]["se3"]["rmse"] == pytest.approx(exact.rmse, rel=1e-6)
    assert document["ate"]["origin"]["available"] is False
    text = lslam("eval", "est.tum", "prism.csv", cwd=tmp_path)
    assert text.stdout.count("n/a (positions alone)") >= 3


def test_the_command_names_lost_poses(tmp_path: Path) -> None:
    write_tum(tmp_path / "est.tum", drive(0.05))
    write_tum(tmp_path / "gt.tum", drive())
    lines = (tmp_path / "gt.tum").read_text().splitlines()
    lines[5] = lines[5].split()[0] + " nan" * 7
    (tmp_path / "gt.tum").write_text("\n".join(lines))
    document = json.loads(lslam("eval", "est.tum", "gt.tum", "--json", cwd=tmp_path).stdout)
    assert document["association"]["matched"] == COUNT - 1
    assert "ground truth: 1 of 120 rows hold NaN or no numbers: lost poses, left out" in document["notes"]
