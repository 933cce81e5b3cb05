"""Truth by itself: poses that are missing show as a jump where rows go by index, and as a gap where they have stamps."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.io.readers import open_sequence
from lslam.pipeline.doctor import Findings
from lslam.pipeline.doctor.examine_positions import examine_gaps, examine_jumps

SAMPLE = Path(__file__).parents[3] / "sample_data"


def jumps(truth: Trajectory | None) -> Findings:
    findings = Findings()
    examine_jumps(truth, findings)
    return findings


def gaps(sequence: Sequence) -> Findings:
    findings = Findings()
    examine_gaps(sequence, findings)
    return findings


@pytest.fixture(scope="module")
def healthy() -> Sequence:
    return open_sequence(SAMPLE)


def truth_of(sequence: Sequence) -> Trajectory:
    assert sequence.ground_truth is not None
    return sequence.ground_truth


def without(truth: Trajectory, first: int, count: int, by_index: bool) -> Trajectory:
    keep = np.delete(np.arange(len(truth)), np.arange(first, first + count))
    part = truth.select(keep)
    return replace(part, stamps_ns=truth.stamps_ns[: len(part)]) if by_index else part


def with_truth(sequence: Sequence, truth: Trajectory) -> Sequence:
    other = copy(sequence)
    other.ground_truth = truth
    return other


@pytest.mark.parametrize(("first", "count"), [(40, 20), (10, 5), (80, 3), (1, 10), (70, 20)])
def test_rows_by_index_jump_where_poses_are_missing(healthy: Sequence, first: int, count: int) -> None:
    [found] = jumps(without(truth_of(healthy), first, count, by_index=True))
    assert found.code == "truth-jumps"
    assert f"1 jump, the largest by {_way(healthy, first, count):.1f} m from pose {first - 1} to the next" in found.what
    assert "were missing" in found.what


def _way(sequence: Sequence, first: int, count: int) -> float:
    positions = truth_of(sequence).positions
    return float(np.linalg.norm(positions[first + count] - positions[first - 1]))


def test_poses_with_stamps_have_a_gap_and_no_jump(healthy: Sequence) -> None:
    truth = without(truth_of(healthy), 40, 20, by_index=False)
    assert jumps(truth) == []
    [found] = gaps(with_truth(healthy, truth))
    assert found.code == "truth-gaps"
    assert "the longest 2.10 s, 3.90 s after the first scan: 20 of 95 scans lie in one" in found.what


@pytest.mark.parametrize("keep", [slice(20, None), slice(None, 80)])
def test_truth_that_begins_late_or_ends_early_has_a_gap(healthy: Sequence, keep: slice) -> None:
    [found] = gaps(with_truth(healthy, truth_of(healthy).select(keep)))
    assert f"{95 - len(range(95)[keep])} of 95 scans lie in one" in found.what


def test_sound_truth_has_neither(healthy: Sequence) -> None:
    truth = truth_of(healthy)
    assert jumps(truth) == gaps(healthy) == []
    rng = np.random.default_rng(0)
    poses = truth.poses.copy()
    poses[:, :3, 3] += 0.1 * rng.normal(size=(95, 3))
    assert jumps(replace(truth, poses=poses)) == [], "noise of a decimetre"
    poses = truth.poses.copy()
    poses[:, :3, 3] *= 1e3
    assert jumps(replace(truth, poses=poses)) == [], "mm have a finding of their own"
    every_other = truth.select(slice(None, None, 2))
    assert jumps(every_other) == gaps(with_truth(healthy, every_other)) == []
    assert jumps(None) == jumps(truth.select(slice(3))) == []
