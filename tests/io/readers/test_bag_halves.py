"""Messages of one stamp: halves of a revolution are put together, repeats are dropped and named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_builders import START_NS, STEP_NS, bag, raw_cloud
from numpy.typing import NDArray

from lslam.core.types.sequence import Sequence
from lslam.io.readers import open_sequence
from lslam.pipeline.convert.bag_writer import BagWriter

TURN_S = 0.1
FIELDS = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("t", "<u4")]
Table = NDArray[Any]
Message = tuple[int, int, Table, str]  # of the header, of the recording, points, frame


def turn(k: int, n: int = 1440, rings: int = 8, width: float = 2 * np.pi) -> Table:
    """Scan `k`: a turn from behind, clockwise, all rings at once, ranges of its own."""
    rng = np.random.default_rng(k)
    table = np.zeros(n, FIELDS)
    share = np.arange(n) // rings * rings / n
    azimuth, r = width * (0.5 - share), rng.uniform(4, 30, n)
    table["x"], table["y"], table["z"] = r * np.cos(azimuth), r * np.sin(azimuth), rng.uniform(-1, 2, n)
    table["intensity"], table["ring"] = rng.random(n), np.arange(n) % rings
    table["t"] = np.round(share * TURN_S * 1e9)
    return table


def stamp(k: int) -> int:
    return START_NS + k * STEP_NS


def write(path: Path, messages: list[Message], names: tuple[str, ...] | None = None) -> Path:
    def fill(writer: BagWriter) -> None:
        for header, recorded, table, frame in messages:
            kept = table if names is None else packed(table, names)
            writer.write("/points", recorded, raw_cloud(writer.store, header, kept, frame=frame))

    return bag(path, fill, "mcap")


def packed(table: Table, names: tuple[str, ...]) -> Table:
    out = np.zeros(len(table), [field for field in FIELDS if field[0] in names])
    for name in names:
        out[name] = table[name]
    return out


def parted(k: int, masks: list[NDArray[np.bool_]], apart_ns: int = 1000) -> list[Message]:
    return [(stamp(k), stamp(k) + n * apart_ns, turn(k)[mask], "lidar") for n, mask in enumerate(masks)]


def sectors(count: int) -> list[NDArray[np.bool_]]:
    which = np.arange(1440) * count // 1440
    return [which == n for n in range(count)]


def assert_whole(sequence: Sequence, count: int) -> None:
    """Every scan has all points of its turn."""
    np.testing.assert_array_equal(sequence.stamps_ns, [stamp(k) for k in range(count)])
    for k in range(count):
        scan, table = sequence.scan(k), turn(k)
        order = np.lexsort(scan.points.T)
        places = np.column_stack([table[a] for a in "xyz"])
        expected = np.lexsort(places.T)
        np.testing.assert_array_equal(scan.points[order], places[expected])
        if scan.rings is not None:
            np.testing.assert_array_equal(scan.rings[order], table["ring"][expected])
        if scan.times is not None:
            np.testing.assert_allclose(scan.times[order], table["t"][expected] * 1e-9, atol=1e-8)


def said(sequence: Sequence) -> str:
    return "\n".join(sequence.notes)


RINGS = [turn(0)["ring"] < 4, turn(0)["ring"] >= 4]


@pytest.mark.parametrize("names", [None, ("x", "y", "z", "intensity"), ("x", "y", "z", "ring")])
@pytest.mark.parametrize("count", [2, 3, 10])
def test_sectors_of_a_turn_are_put_together(tmp_path: Path, names: tuple[str, ...] | None, count: int) -> None:
    messages = [m for k in range(6) for m in parted(k, sectors(count), STEP_NS // count)]
    sequence = open_sequence(write(tmp_path / "a.mcap", messages, names))
    assert_whole(sequence, 6)
    assert not sequence.problems
    assert "/points: 6 scans come in several messages of one stamp" in said(sequence)


def test_points_are_in_the_order_they_were_measured_whichever_half_came_first(tmp_path: Path) -> None:
    messages = [m for k in range(4) for m in parted(k, sectors(2)[::-1])]
    sequence = open_sequence(write(tmp_path / "a.mcap", messages))
    assert_whole(sequence, 4)
    np.testing.assert_array_equal(sequence.scan(1).points[:, 0], turn(1)["x"])


def test_blocks_of_rings_are_put_together(tmp_path: Path) -> None:
    messages = [m for k in range(4) for m in parted(k, RINGS)]
    assert_whole(open_sequence(write(tmp_path / "a.mcap", messages)), 4)


def test_halves_of_a_sensor_that_does_not_turn_are_told_by_their_times(tmp_path: Path) -> None:
    """Seventy degrees, scanned twice in a sweep: all directions are seen by both halves."""

    def halves(k: int) -> list[Message]:
        both = [turn(k, width=1.2), turn(100 + k, width=1.2)]
        for n, table in enumerate(both):
            table["t"] = table["t"] // 2 + n * 50_000_000
        return [(stamp(k), stamp(k) + n, table, "lidar") for n, table in enumerate(both)]

    sequence = open_sequence(write(tmp_path / "a.mcap", [m for k in range(4) for m in halves(k)]))
    scan = sequence.scan(2)
    assert len(scan) == 2880
    assert scan.times is not None
    assert scan.times[-1] == pytest.approx(0.0997, abs=4e-4)
    assert (np.diff(scan.times) >= 0).all()


def test_repeats_are_dropped_and_named(tmp_path: Path) -> None:
    messages = [(stamp(k), stamp(k) + n, turn(k), "lidar") for k in range(5) for n in range(1 + (k % 2))]
    sequence = open_sequence(write(tmp_path / "a.mcap", messages))
    assert_whole(sequence, 5)
    assert sequence.problems == ["/points: scans repeat a stamp 2 times: the first one of each counts"]
    assert "put together" not in said(sequence)


def test_repeats_among_halves_are_dropped_and_named(tmp_path: Path) -> None:
    messages = [m for k in range(6) for m in parted(k, sectors(2))]
    first = messages[4]
    messages.insert(5, (first[0], first[1] + 1, first[2], first[3]))
    sequence = open_sequence(write(tmp_path / "a.mcap", messages))
    assert_whole(sequence, 6)
    assert sequence.problems == ["/points: scans repeat a stamp 1 times: the first one of each counts"]


def test_the_second_return_of_the_same_beams_is_no_half(tmp_path: Path) -> None:
    def last(k: int) -> Table:
        table = turn(k)
        far = np.arange(len(table)) % 3 == 0
        for axis in "xyz":
            table[axis][far] *= 1.5
        return table

    messages = [(stamp(k), stamp(k) + n, (turn, last)[n](k), "lidar") for k in range(4) for n in range(2)]
    sequence = open_sequence(write(tmp_path / "a.mcap", messages))
    assert_whole(sequence, 4)
    assert "repeat a stamp 4 times" in sequence.problems[0]


def test_whole_turns_whose_stamps_stand_still_are_not_put_together(tmp_path: Path) -> None:
    """A coarse clock, or one that stuck: times of the points go on, but the directions come again."""

    def later(k: int) -> Table:
        table = turn(k)
        table["t"] += np.uint32(k % 2 * 100_000_000)
        return table

    messages = [(stamp(k // 2 * 2), stamp(k), later(k), "lidar") for k in range(8)]
    sequence = open_sequence(write(tmp_path / "a.mcap", messages))
    assert max(len(sequence.scan(k)) for k in range(len(sequence))) == 1440
    assert "put together" not in said(sequence)


def test_of_many_stamps_some_are_looked_at_and_each_scan_is_judged_by_itself(tmp_path: Path) -> None:
    """One of 90 pairs is a repeat that nobody looked at: its scan has its points once."""

    def pair(k: int) -> list[Message]:
        small = turn(k, 720)
        half = np.arange(720) < 360
        tables = [small, small] if k == 44 else [small[half], small[~half]]
        return [(stamp(k), stamp(k) + n, table, "lidar") for n, table in enumerate(tables)]

    sequence = open_sequence(write(tmp_path / "a.mcap", [m for k in range(90) for m in pair(k)]))
    assert [len(sequence.scan(k)) for k in range(90)] == [720] * 90
    assert ", as 40 of 40 looked at are" in said(sequence)


def test_a_half_without_points_leaves_the_other(tmp_path: Path) -> None:
    messages = [m for k in range(4) for m in parted(k, sectors(2))]
    messages[3] = (*messages[3][:2], messages[3][2][:0], "lidar")
    sequence = open_sequence(write(tmp_path / "a.mcap", messages))
    assert [len(sequence.scan(k)) for k in range(4)] == [1440, 720, 1440, 1440]


def test_points_without_a_return_have_no_say(tmp_path: Path) -> None:
    """Zeros of both halves are alike, and lie in no direction."""

    def halves(k: int) -> list[Message]:
        messages = parted(k, sectors(2))
        for _, _, table, _ in messages:
            for axis in "xyz":
                table[axis][::3] = 0
        return messages

    sequence = open_sequence(write(tmp_path / "a.mcap", [m for k in range(4) for m in halves(k)]))
    assert [int((sequence.scan(k).points != 0).any(axis=1).sum()) for k in range(4)] == [960] * 4
    assert not sequence.problems
