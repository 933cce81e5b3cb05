"""Association: the poses that are compared, and the notes when there are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evaluation_drives import disturb, drive
from hypothesis import given
from hypothesis import strategies as st

from lslam.core.errors import InputError
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.associate import associate, estimate_offset, nearest_one_to_one, time_range

stamps = st.lists(st.integers(0, 10_000), min_size=1, max_size=30, unique=True).map(
    lambda v: np.array(sorted(v), np.int64)
)


@given(stamps, stamps, st.integers(0, 500))
def test_matches_are_one_to_one_near_and_in_order(a: np.ndarray, b: np.ndarray, limit: int) -> None:
    i, j = nearest_one_to_one(a, b, limit)
    assert len(set(i.tolist())) == len(i) == len(set(j.tolist()))
    assert (np.diff(i) > 0).all()
    assert (np.diff(j) > 0).all()
    assert (np.abs(a[i] - b[j]) <= limit).all()
    if np.abs(a[:, None] - b[None, :]).min() <= limit:
        assert len(i) >= 1


@given(stamps)
def test_the_same_stamps_all_match(a: np.ndarray) -> None:
    i, j = nearest_one_to_one(a, a, 0)
    assert i.tolist() == j.tolist() == list(range(len(a)))


def test_two_that_want_one_partner() -> None:
    i, j = nearest_one_to_one(np.array([100, 108]), np.array([0, 107, 500]), 10)
    assert (i.tolist(), j.tolist()) == ([1], [1])


def test_missing_scans_are_left_out(truth: Trajectory) -> None:
    kept = np.delete(np.arange(len(truth)), [5, 6, 100])
    matches = associate(truth.select(kept), truth)
    assert len(matches.stamps_ns) == len(kept) == matches.possible
    np.testing.assert_array_equal(matches.estimate, matches.truth)
    assert "nearest stamp" in matches.recipe


def test_interpolated_dense_truth_is_more_accurate_than_the_nearest() -> None:
    dense = drive(3000, step_ns=10_000_000)
    every = dense.select(slice(5, 2900, 10))
    shifted = replace(every, stamps_ns=every.stamps_ns + 4_000_000)
    matches = associate(shifted, dense)
    assert "interpolated" in matches.recipe
    assert matches.stamps_ns.tolist() == shifted.stamps_ns.tolist()
    share = 0.4
    expected = (1 - share) * dense.positions[5:2900:10] + share * dense.positions[6:2901:10]
    np.testing.assert_allclose(matches.truth[:, :3, 3], expected, atol=1e-9)


def test_holes_of_dense_truth_are_not_bridged() -> None:
    dense = drive(3000, step_ns=10_000_000)
    holed = dense.select(np.r_[0:1000, 1500:3000])
    every = replace(dense.select(slice(5, 2900, 10)), stamps_ns=dense.stamps_ns[5:2900:10] + 4_000_000)
    matches = associate(every, holed)
    inside = (matches.stamps_ns > dense.stamps_ns[1000]) & (matches.stamps_ns < dense.stamps_ns[1499])
    assert "interpolated" in matches.recipe, "it is as dense as it was elsewhere"
    assert not inside.any()
    assert len(matches.stamps_ns) == pytest.approx(240, abs=2)


def test_poses_before_and_after_dense_truth_have_no_partner() -> None:
    dense = drive(300, step_ns=10_000_000)
    around = replace(drive(60), stamps_ns=np.arange(-20, 40, dtype=np.int64) * 100_000_000 + 4_000_000)
    matches = associate(around, dense)
    assert "interpolated" in matches.recipe
    assert matches.stamps_ns.tolist() == (np.arange(30) * 100_000_000 + 4_000_000).tolist()
    np.testing.assert_allclose(matches.seconds, 0.1 * np.arange(30))


def test_seconds_count_from_the_first_match(truth: Trajectory) -> None:
    matches = associate(truth.select(slice(7, 20)), truth)
    np.testing.assert_allclose(matches.seconds, 0.1 * np.arange(13))


def test_files_without_stamps_go_by_index(truth: Trajectory) -> None:
    bare = replace(truth, has_stamps=False)
    both = associate(bare, bare)
    assert both.recipe.endswith("because estimate and ground truth have no stamps")
    assert both.seconds is None
    one, other = associate(bare, truth), associate(truth, bare)
    assert one.recipe.endswith("because estimate has no stamps")
    assert other.recipe.endswith("because ground truth has no stamps")
    assert one.seconds is not None
    assert one.stamps_ns.tolist() == truth.stamps_ns.tolist()
    with pytest.raises(InputError, match=r"counts differ: 299 poses .* 300 .*--times"):
        associate(bare.select(slice(0, 299)), bare)


def test_no_common_time_names_both_ranges(truth: Trajectory) -> None:
    late = replace(truth, stamps_ns=truth.stamps_ns + 10**12)
    with pytest.raises(InputError, match=r"1000\.000 \.\. 1029\.900 s.* 0\.000 \.\. 29\.900 s.*--time-offset auto"):
        associate(late, truth)


def test_stamps_between_scans_name_the_distance(truth: Trajectory) -> None:
    between = replace(truth, stamps_ns=truth.stamps_ns + 50_000_000)
    with pytest.raises(InputError, match=r"0\.050 s apart \(median\): raise --max-diff"):
        associate(between, truth)
    assert len(associate(between, truth, max_diff=0.06).stamps_ns) >= 299


@pytest.mark.parametrize("which", ["last", "first"])
def test_recordings_that_share_an_instant_share_time(which: str, truth: Trajectory) -> None:
    """One begins where the other ends: no clock need be shifted by as much as one of them lasts."""
    whole = int(truth.stamps_ns[-1] - truth.stamps_ns[0])
    moved = replace(truth, stamps_ns=truth.stamps_ns + (whole if which == "last" else -whole))
    with pytest.raises(InputError, match=r"only 1 poses match .* apart \(median\): raise --max-diff"):
        associate(moved, truth)


def test_a_range_of_time_in_words(truth: Trajectory) -> None:
    assert time_range(truth, 2_000_000_000) == "2.000 .. 31.900 s"
    assert time_range(replace(truth, has_stamps=False)) == "300 poses without stamps"
    assert time_range(truth.select(slice(0, 0))) == "no poses"


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_poses(count: int, truth: Trajectory) -> None:
    with pytest.raises(InputError, match=f"estimate truth has {count} poses, 3 are needed"):
        associate(truth.select(slice(0, count)), truth)


@pytest.mark.parametrize("shift_s", [-1317042272.35, -86400.0, -3.21, -0.037, 0.0, 0.5, 1e6])
def test_a_shifted_clock_is_found_exactly_when_stamps_are_the_same(shift_s: float, truth: Trajectory) -> None:
    shift = round(shift_s * 1e9)
    own = disturb(truth).select(slice(40, 260))
    offset, score = estimate_offset(replace(own, stamps_ns=own.stamps_ns - shift), truth)
    assert offset == shift
    assert score > 0.9


def test_a_small_shift_between_different_stamps() -> None:
    dense = drive(6000, step_ns=10_000_000)
    poses = disturb(dense.select(slice(700, 5000, 10)), size=0.005, drift=0.0005)
    jitter = np.random.default_rng(3).integers(-3_000_000, 3_000_000, len(poses))
    offset, _ = estimate_offset(replace(poses, stamps_ns=poses.stamps_ns + 123_456_789 + jitter), dense)
    assert offset == pytest.approx(-123_456_789, abs=10_000_000)


def test_motion_that_determines_nothing_is_refused() -> None:
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, 0, 3] = np.arange(200)
    even = Trajectory(np.arange(200, dtype=np.int64) * 10**8, poses)
    with pytest.raises(InputError, match=r"fit nowhere.*give the offset in seconds"):
        estimate_offset(replace(even, stamps_ns=even.stamps_ns + 10**12), even)


def test_another_drive_is_refused(truth: Trajectory) -> None:
    k = np.arange(300)
    poses = np.tile(np.eye(4), (300, 1, 1))
    poses[:, 0, 3] = np.cumsum(2 + np.sin(k * k * 0.01))
    other = Trajectory(truth.stamps_ns, poses)
    with pytest.raises(InputError, match="--time-offset auto"):
        estimate_offset(other, truth)


def test_a_periodic_drive_fits_more_than_once() -> None:
    k = np.arange(400)
    poses = np.tile(np.eye(4), (400, 1, 1))
    poses[:, 0, 3] = np.cumsum(2 + np.sin(2 * np.pi * k / 50))
    wave = Trajectory(k.astype(np.int64) * 10**8, poses)
    with pytest.raises(InputError, match="fit alike"):
        estimate_offset(wave.select(slice(100, 250)), wave)
