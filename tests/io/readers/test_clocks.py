"""Header stamps held against the times of recording: the impossible clock loses, and nothing legitimate is touched."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bag_builders import GRAVITY, START_NS, STEP_NS, Fill, bag, clouds, raw_cloud, scan, together, transforms
from numpy.typing import NDArray

from lslam.io.readers import open_sequence
from lslam.io.readers.bag_topics import put_in_order
from lslam.io.readers.ground_truth import Voice
from lslam.pipeline.convert.bag_writer import BagMessages, BagWriter

Stamps = NDArray[np.int64]
SECOND = 10**9
S37 = 37 * SECOND
COUNT = 30
K = np.arange(COUNT)
TRUE = START_NS + K * STEP_NS


def ordered(headers: Stamps, recorded: Stamps) -> tuple[Stamps, Stamps, Voice]:
    voice = Voice([], [])
    order, stamps = put_in_order(np.asarray(headers, np.int64), np.asarray(recorded, np.int64), "scans", voice)
    return order, stamps, voice


def delays(count: int, sigma_s: float) -> Stamps:
    """Of recording: 20 ms and more."""
    more = np.abs(np.random.default_rng(3).normal(0, sigma_s, count)) if sigma_s else np.zeros(count)
    return np.rint((0.02 + more) * 1e9).astype(np.int64)


# What the header of the sensor says in place of TRUE, and what the sentence about it says.
FAULTS: dict[str, tuple[Callable[[], Stamps], str]] = {
    "locks on UTC": (lambda: np.where(K < 8, 12 * SECOND + K * STEP_NS, TRUE), "step by +1699999988.223 s at message 8,"),
    "steps back": (lambda: TRUE - S37 * (K >= 8), "step by -36.900 s at message 8,"),
    "steps on": (lambda: TRUE + S37 * (K >= 8), "step by +37.100 s at message 8,"),
    "steps back by less than before": (lambda: TRUE - 5 * STEP_NS * (K >= 8), "step by -0.400 s at message 8,"),
    "steps back by little more than an interval": (
        lambda: TRUE - 128 * 10**6 * (K >= 8), "step by -0.028 s at message 8,"
    ),
    "steps on by half a second": (lambda: TRUE + 5 * STEP_NS * (K >= 8), "step by +0.600 s at message 8,"),
    "steps on and back": (lambda: TRUE + S37 * ((K >= 8) & (K < 20)), "step by +37.100 s at message 8 and at 1 more,"),
    "is wrong once": (lambda: TRUE - S37 * (K == 12), "step by -36.900 s at message 12 and at 1 more,"),
    "has no stamps at first": (lambda: TRUE * (K >= 5), "stand still at message 1 and at 4 more,"),
    "stands still for a while": (lambda: np.where((K > 9) & (K < 16), TRUE[9], TRUE), "at message 10 and at 6 more,"),
    "stands still from the middle on": (lambda: TRUE[np.minimum(K, 14)], "stand still at message 15 and at 14 more,"),
    "two clocks in turns": (lambda: np.where(K % 2, 12 * SECOND + K * STEP_NS, TRUE), "at message 1 and at 28 more,"),
    "two clocks in turns that interleave": (lambda: TRUE + 33 * 10**7 * (K % 2), "at message 1 and at 28 more,"),
    "two clocks in turns by chance": (
        lambda: TRUE + S37 * (np.random.default_rng(0).random(COUNT) < 0.5), "on one clock|onto one clock"
    ),
}  # fmt: skip


@pytest.mark.parametrize("sigma_s", [0.0, 0.006])
@pytest.mark.parametrize("fault", FAULTS)
def test_steps_of_the_headers_are_taken_out_by_the_times_of_recording(fault: str, sigma_s: float) -> None:
    headers, words = FAULTS[fault]
    order, stamps, voice = ordered(headers(), TRUE + delays(COUNT, sigma_s))
    np.testing.assert_array_equal(order, K)
    np.testing.assert_allclose(np.diff(stamps) * 1e-9, 0.1, atol=3 * sigma_s + 1e-9)
    assert abs(stamps[0] - TRUE[0]) <= (3 * sigma_s + 1e-9) * 1e9, "on the clock that is nearest to the recording"
    (problem,) = voice.problems
    assert any(word in problem for word in words.split("|")), problem
    assert not voice.notes


@pytest.mark.parametrize(("value", "words"), [(0, "no stamps in their headers"), (START_NS, "stand still at 17")])
def test_where_the_headers_stand_still_throughout_the_times_of_recording_count(value: int, words: str) -> None:
    recorded = TRUE + delays(COUNT, 0.006)
    order, stamps, voice = ordered(np.full(COUNT, value), recorded)
    np.testing.assert_array_equal(order, K)
    np.testing.assert_array_equal(stamps, recorded)
    assert words in voice.problems[0]


def test_stamps_of_whole_seconds_are_no_clock_of_scans() -> None:
    _, stamps, voice = ordered(TRUE // SECOND * SECOND, TRUE)
    np.testing.assert_array_equal(stamps, TRUE)
    assert "stand still" in voice.problems[0]


def burst(recorded: Stamps) -> Stamps:
    """A disk that writes nothing for 1.5 s."""
    return np.where((recorded > recorded[9]) & (recorded < recorded[9] + 1.5e9), recorded[9] + int(1.5e9), recorded)


def test_what_is_legitimate_stays_as_it_is() -> None:
    recorded = TRUE + delays(COUNT, 0.006)
    pause = 600 * SECOND * (K >= 12)
    jitter = (np.clip(np.random.default_rng(1).normal(0, 0.01, COUNT), -0.045, 0.045) * 1e9).astype(np.int64)
    gaps = np.setdiff1d(K, [12, 13, 14, 18, 19])
    for headers, times, words in (
        (TRUE, recorded, ""),
        (TRUE + pause, recorded + pause, ""),
        (TRUE[gaps], recorded[gaps], ""),
        (TRUE, burst(recorded), None),
        (TRUE[gaps], burst(recorded)[gaps], None),
        (TRUE + jitter, recorded + jitter, ""),
        (TRUE + jitter, recorded, ""),
        (TRUE, recorded + S37 * (K >= 8), "the times of recording jump by up to 37.1"),
        (TRUE, recorded + 90 * 86400 * SECOND, ""),
        (TRUE + pause, TRUE[0] + (TRUE - TRUE[0]) // 2, "run 2 times as fast as the stamps of the headers"),
        (TRUE + pause, TRUE[0] + K * 1_000_000, "run 100 times as fast"),
        (TRUE + pause, np.zeros(COUNT, np.int64), ""),
    ):
        order, stamps, voice = ordered(headers, times)
        np.testing.assert_array_equal(stamps, headers)
        np.testing.assert_array_equal(order, np.arange(len(headers)))
        assert not voice.problems
        assert words is None or [words in note for note in voice.notes] == [True] * bool(words), voice.notes


def test_samples_that_arrive_in_batches_keep_their_own_clock() -> None:
    """200 Hz in batches of 20: the times of recording are uneven, the headers are not."""
    k = np.arange(2000)
    true = START_NS + k * 5_000_000
    recorded = np.repeat(true[19::20] + delays(100, 0.002), 20)
    locked = np.where(k < 800, 12 * SECOND + k * 5_000_000, true)
    for headers in (true, true - S37 * (k >= 800), true + 3 * STEP_NS * (k >= 801), locked):
        order, stamps, voice = ordered(headers, recorded)
        np.testing.assert_array_equal(order, k)
        np.testing.assert_allclose(stamps, true, atol=5_000_000)
        np.testing.assert_array_equal(np.diff(stamps), 5_000_000)
        assert len(voice.problems) == (headers is not true)
    twice = true.copy()
    twice[5::7] = true[4::7][: len(twice[5::7])]
    _, stamps, voice = ordered(twice, recorded)
    assert np.isin(stamps, true).all(), "repeated stamps are dropped, and the others stay"
    assert "repeat a stamp" in voice.problems[0]


def test_two_messages_of_one_stamp_are_no_clock_that_stands_still() -> None:
    _, stamps, voice = ordered(np.repeat(TRUE, 2), np.repeat(TRUE, 2) + 50_000_000 * np.tile([0, 1], COUNT))
    np.testing.assert_array_equal(stamps, TRUE)
    assert "repeat a stamp 30 times" in voice.problems[0]


def on_a_clock(shift_ns: Callable[[int], int]) -> Fill:
    """Scans at 10 Hz and an IMU at 100 Hz that are stamped by a clock which is off by `shift_ns` of the true time."""

    def fill(writer: BagWriter) -> None:
        for k in range(COUNT):
            message = writer.messages.cloud(scan(k, 50, stamp_ns=int(TRUE[k]) + shift_ns(int(TRUE[k]))), "lidar")
            writer.write("/points", int(TRUE[k]) + 15_000_000, message)
        for k in range(COUNT * 10):
            stamp = START_NS + k * 10_000_000
            values = GRAVITY, np.array([0, 0, 0.001 * k])
            message = writer.messages.imu(stamp + shift_ns(stamp), *values, "imu")
            writer.write("/imu", stamp + 2_000_000, message)

    return fill


@pytest.mark.parametrize("shift_s", [-37.0, 37.0, 0.5])
def test_a_step_does_not_tear_scans_and_imu_of_one_clock_apart(tmp_path: Path, shift_s: float) -> None:
    at = START_NS + 12 * STEP_NS - 3_000_000
    fill = on_a_clock(lambda ns: int(shift_s * 1e9) * (ns >= at))
    sequence = open_sequence(bag(tmp_path / "a.mcap", together(fill), "mcap"))
    np.testing.assert_array_equal(sequence.stamps_ns, TRUE)
    assert sequence.imu is not None
    np.testing.assert_array_equal(sequence.imu.stamps_ns, START_NS + np.arange(COUNT * 10) * 10_000_000)
    np.testing.assert_allclose(sequence.imu.gyro[:, 2], 0.001 * np.arange(COUNT * 10))
    assert sum("brought onto one clock" in p for p in sequence.problems) == 2


STREAMS = ("/points", "/rear", "/imu", "/fix", "/ground_truth")


def on_clocks(epochs_ns: dict[str, int]) -> Fill:
    """Two LiDARs, an IMU, fixes and truth of one time; stamps of each topic are so many ns off the true time."""

    def fill(writer: BagWriter) -> None:
        store = writer.store
        for k in range(COUNT):
            at = {topic: int(TRUE[k]) + epochs_ns[topic] for topic in STREAMS}
            place = np.array([48.0, 11.0 + 1e-6 * k, 500.0])
            for topic, message in {
                "/points": BagMessages(store).cloud(scan(k, 50, stamp_ns=at["/points"]), "lidar"),
                "/rear": BagMessages(store).cloud(scan(100 + k, 50, stamp_ns=at["/rear"]), "rear"),
                "/imu": BagMessages(store).imu(at["/imu"], GRAVITY, np.full(3, 0.01 * k), "imu"),
                "/fix": BagMessages(store).fix(at["/fix"], place, 1.0, "gnss"),
                "/ground_truth": BagMessages(store).odometry(at["/ground_truth"], np.eye(4), "map", "lidar"),
            }.items():
                writer.write(topic, int(TRUE[k]) + 15_000_000, message)

    return together(transforms({("lidar", "rear"): np.eye(4)}), fill)


@pytest.mark.parametrize("off_s", [-1_699_999_990.0, 37.0, 5.0])
@pytest.mark.parametrize("other", STREAMS)
def test_streams_on_a_clock_of_another_epoch_are_brought_onto_that_of_the_scans(
    tmp_path: Path, other: str, off_s: float
) -> None:
    """What was recorded together happened together."""
    epochs = {topic: int(off_s * 1e9) * (topic == other) for topic in STREAMS}
    path = bag(tmp_path / "a.mcap", on_clocks(epochs), "mcap")
    sequence = open_sequence(path, lidar_topic="/points,/rear")
    for stream in (sequence, sequence.imu, sequence.gnss, sequence.ground_truth):
        assert stream is not None
        np.testing.assert_array_equal(stream.stamps_ns, TRUE + epochs["/points"])
    assert [len(sequence.scan(k)) for k in (0, 10, COUNT - 1)] == [100, 100, 100]
    said = [problem.split(":")[0] for problem in sequence.problems if "s off that of the scans" in problem]
    assert len(said) == (4 if other == "/points" else 1), said


def by_points(start_s: float, with_imu: bool = False) -> Fill:
    """Scans without stamps in their headers, recorded unevenly, whose points have absolute times from `start_s`."""

    def fill(writer: BagWriter) -> None:
        for k in range(COUNT):
            table = np.zeros(50, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<f8")])
            table["x"], table["timestamp"] = 1 + np.arange(50), start_s + 0.1 * k + np.linspace(0, 0.0999, 50)
            message = raw_cloud(writer.store, 0, table)
            writer.write("/points", int(TRUE[k] + 100_000_000 + delays(COUNT, 0.02)[k]), message)

    return fill


@pytest.mark.parametrize("start_s", [START_NS * 1e-9, 123.25])
def test_scans_without_stamps_are_stamped_by_absolute_times_of_their_points(tmp_path: Path, start_s: float) -> None:
    """Of the epoch of the recording, or since the sensor was switched on: then by the clock of the recording."""
    sequence = open_sequence(bag(tmp_path / "a.bag", by_points(start_s)))
    assert len(sequence) == COUNT
    np.testing.assert_allclose(np.diff(sequence.stamps_ns), STEP_NS, atol=1000)
    late = 0.1e9 + delays(COUNT, 0.02).min() if start_s < 1000 else 0
    assert abs(sequence.stamps_ns[0] - TRUE[0] - late) < 2000
    for k in (0, 17):
        one = sequence.scan(k)
        assert abs(one.stamp_ns - sequence.stamps_ns[k]) < 10
        assert one.times is not None
        np.testing.assert_allclose(one.times, np.linspace(0, 0.0999, 50), atol=1e-6)
    assert any("from the absolute times of the points, field 'timestamp'" in n for n in sequence.notes)


def test_fixes_without_a_fix_do_not_cost_the_clock_of_the_others(tmp_path: Path) -> None:
    def fill(writer: BagWriter) -> None:
        for k in range(COUNT):
            stamp = int(TRUE[k]) - S37 * (k >= 12)
            message = writer.messages.fix(stamp, np.array([48.0, 11.0 + 1e-6 * k, 500.0]), 1.0, "gnss")
            if k % 7 == 3:
                message.status.status = -1
            writer.write("/fix", int(TRUE[k]) + 5_000_000, message)

    gnss = open_sequence(bag(tmp_path / "a.mcap", together(clouds(COUNT, n=20), fill), "mcap")).gnss
    assert gnss is not None
    np.testing.assert_array_equal(gnss.stamps_ns, TRUE[K % 7 != 3])
    np.testing.assert_allclose(gnss.lat_lon_alt[:, 1], 11.0 + 1e-6 * K[K % 7 != 3])


def test_a_recording_that_was_played_in_a_loop_is_read_once(tmp_path: Path) -> None:
    def fill(writer: BagWriter) -> None:
        for k in range(2 * COUNT):
            one = scan(k % COUNT, 50)
            writer.write("/points", START_NS + k * STEP_NS, writer.messages.cloud(one, "lidar"))
            message = writer.messages.imu(one.stamp_ns, GRAVITY, np.full(3, 0.01 * (k % COUNT)), "imu")
            writer.write("/imu", START_NS + k * STEP_NS, message)

    sequence = open_sequence(bag(tmp_path / "a.mcap", fill, "mcap"))
    np.testing.assert_array_equal(sequence.stamps_ns, TRUE)
    assert sequence.imu is not None
    np.testing.assert_array_equal(sequence.imu.stamps_ns, TRUE)
    said = [
        p for p in sequence.problems if "30 messages, message 30 the first, are copies of earlier ones: left out" in p
    ]
    assert len(said) == 2


@pytest.mark.parametrize("at_end", [False, True])
@pytest.mark.parametrize("step_s", [0.3, -0.3, 37.0, -5.0])
def test_a_step_of_the_points_clock_does_not_move_scans_whose_headers_go_on(
    tmp_path: Path, step_s: float, at_end: bool
) -> None:
    """Headers of the scans' begin or end; a sliver of a sweep, as recordings begin with, is no step."""

    def fill(writer: BagWriter) -> None:
        for k in range(COUNT):
            within = np.linspace(0, 0.0999, 50)[45 if at_end and k == 0 else 0 :]
            table = np.zeros(len(within), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<f8")])
            table["x"] = 1 + np.arange(len(within))
            table["timestamp"] = TRUE[k] * 1e-9 + within + step_s * (k >= 8)
            message = raw_cloud(writer.store, int(TRUE[k]) + 99_900_000 * at_end, table)
            writer.write("/points", int(TRUE[k]) + 110_000_000, message)

    sequence = open_sequence(bag(tmp_path / "a.mcap", fill, "mcap"))
    first = 1 if at_end else 0
    stamps = np.array([sequence.scan(k).stamp_ns for k in range(first, COUNT)])
    np.testing.assert_allclose(stamps, TRUE[first:], atol=1000)
    assert at_end is False or abs(sequence.scan(0).stamp_ns - TRUE[0] - 91_700_000) < 200_000
    assert abs(step_s) > 1 or "the clock of its points is" in sequence.scan(9).fault
    (problem,) = [p for p in sequence.problems if "against the stamps of the headers: the headers count" in p]
    assert abs(float(problem.split("step by ")[1].split(" s")[0]) - abs(step_s)) < 0.1
    assert not sequence.scan(3).fault


def test_any_two_clocks_give_increasing_stamps_of_different_messages() -> None:
    rng = np.random.default_rng(5)

    def clock(count: int) -> Stamps:
        base = int(rng.choice([0, START_NS, -2 * 10**18, 4 * 10**18, 12 * SECOND]))
        even = base + np.arange(count) * int(10 ** rng.uniform(3, 10))
        kinds = [
            even,
            even + rng.normal(0, 1e8, count).astype(np.int64),
            np.full(count, base),
            rng.integers(-(2**61), 2**61, count),
            even + np.where(rng.random(count) < 0.1, int(rng.choice([S37, -(10**18)])), 0),
        ]
        return np.asarray(kinds[int(rng.integers(len(kinds)))], np.int64)

    for _ in range(400):
        count = int(rng.integers(0, 60))
        order, stamps, _ = ordered(clock(count), clock(count))
        assert len(np.unique(order)) == len(order) == len(stamps)
        assert (stamps[1:] > stamps[:-1]).all()


def test_the_clock_that_counts_is_said(tmp_path: Path) -> None:
    sequence = open_sequence(bag(tmp_path / "a.mcap", on_a_clock(lambda ns: 0), "mcap"))
    assert (
        "/points: scans have the stamps of their headers; they were recorded 0.015 s after (median)" in sequence.notes
    )


def test_messages_lost_while_the_recorder_was_late_are_no_step_of_the_headers() -> None:
    """A disk that hangs for 1.5 s in 20: half a second of scans is lost, the others are written late and at once."""
    true = START_NS + np.arange(200) * STEP_NS
    hung = (true > true[99]) & (true < true[99] + 15 * 10**8)
    recorded = np.where(hung, true[99] + 15 * 10**8, true) + delays(200, 0.006)
    kept = np.setdiff1d(np.arange(200), [102, 103, 104, 105, 106, 108, 109, 110])
    _, stamps, voice = ordered(true[kept], np.maximum.accumulate(recorded)[kept])
    np.testing.assert_array_equal(stamps, true[kept])
    assert not voice.problems
