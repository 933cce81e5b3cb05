"""Revolutions of a Velodyne sensor: cut where its azimuth passes the one it began with, stamped by its own clock."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from lslam.core.errors import InputError
from lslam.io.formats.point_cloud import PointCloud
from lslam.io.formats.velodyne_packets import (
    BLOCKS,
    DUAL,
    FLAG,
    HOUR_US,
    MODELS,
    RETURNS,
    SIZE,
    TURN,
    Blocks,
    VelodyneModel,
    points_of,
    split_blocks,
)
from lslam.io.readers.ground_truth import Voice
from lslam.io.readers.pcap_revolutions import ALONE, Integers, Opened, Packets, in_order, no_slivers, of_one_sender

_HOUR_NS = HOUR_US * 1000
_SAID_NS = 10**9  # clocks that are nearer are the same clock, and the way of a packet


@dataclass(frozen=True)
class VelodyneRevolutions:
    """Satisfies `Revolutions`.

    began : azimuth of the first block, 0.01 deg
    packets : (P,) datagrams in order; azimuth : (P,) of their first blocks from `began`, unwrapped; times_ns : (P,)
    turns : (N,) which revolutions have points
    """

    datagrams: Packets
    model: VelodyneModel
    began: int
    packets: Integers
    azimuth: Integers
    times_ns: Integers
    turns: Integers

    @cached_property
    def stamps_ns(self) -> Integers:
        """(N,) when the first block of each revolution was measured."""
        return np.array([self._stamp(turn) for turn in self.turns.tolist()], np.int64)

    def read(self, index: int) -> tuple[PointCloud, Integers]:
        """Points of revolution `index` in the order they were measured, and when each was, ns."""
        turn = int(self.turns[index])
        # One packet more: the azimuth of the next block tells how far the last one turns.
        blocks = self._blocks(self._begin(turn), int(np.searchsorted(self.azimuth, (turn + 1) * TURN)) + 1)
        return points_of(blocks, blocks.azimuth // TURN == turn, self.began, self.model)

    def _stamp(self, turn: int) -> int:
        begin = self._begin(turn)
        blocks = self._blocks(begin, begin + 2)
        times_ns = blocks.times_ns[blocks.azimuth >= turn * TURN]
        return int(times_ns[0] if len(times_ns) else self.times_ns[begin:][:2][-1])

    def _begin(self, turn: int) -> int:
        """The packet within which the revolution begins."""
        return max(int(np.searchsorted(self.azimuth, turn * TURN, "right")) - 1, 0)

    def _blocks(self, begin: int, end: int) -> Blocks:
        packets = self.datagrams.payloads(self.packets[begin:end])
        return split_blocks(packets, self.azimuth[begin:end], self.times_ns[begin:end], self.model)


def open_velodyne(path: Path, datagrams: Packets, voice: Voice) -> Opened:
    """Raises InputError for a model that is not known, and for less than one revolution."""
    which = np.flatnonzero(datagrams.sizes == SIZE)
    which = which[(datagrams.bytes_at(which, (0, 1)) == FLAG).all(axis=1)]
    if not len(which):
        raise InputError(f"{path} holds no packets of {SIZE} bytes that begin as Velodyne's do")
    which = of_one_sender(datagrams, which, "Velodyne packets", voice)
    model, mode = _factory(path, datagrams, which)
    raw = datagrams.bytes_at(which, (1200, 1201, 1202, 1203)).astype(np.int64)
    times = _absolute(raw @ (1 << np.array([0, 8, 16, 24])), datagrams.stamps_ns[which], voice)
    order = in_order(times, "Velodyne packets", voice)
    which, times = which[order], times[order]
    angle = datagrams.bytes_at(which, (2, 3)).astype(np.int64) @ (1 << np.array([0, 8]))
    azimuth, rate = _unwrapped(path, angle, times)
    per_packet = BLOCKS // 2 if mode == DUAL else BLOCKS
    end = int(azimuth[-1]) + round(rate * model.block_ns * per_packet)
    turns, counts = np.unique(azimuth // TURN, return_counts=True)
    # The last block reaches to where the next one would begin, give or take its rounding.
    is_whole = turns < (end + round(rate * model.block_ns)) // TURN
    if not is_whole.any() and end < ALONE * TURN:
        raise InputError(f"{path} holds {end / TURN:.2f} of a revolution of the {model.name}: one is needed")
    if not is_whole.any():
        voice.notes.append(f"the capture holds {end / TURN:.2f} of one revolution: it is the only scan")
        is_whole[0] = True
    elif end % TURN > TURN // 100:
        voice.notes.append(f"the last {end % TURN / TURN:.2f} of a revolution are no scan")
    turns = turns[is_whole][no_slivers(counts[is_whole] * (rate * model.block_ns * per_packet / TURN), voice)]
    revolutions = VelodyneRevolutions(datagrams, model, int(angle[0]), which, azimuth, times, turns)
    voice.notes.append(
        f"{len(which)} packets of a {model.name}, {RETURNS[mode]} return{' read: the last' if mode == DUAL else ''}; scans are "
        f"cut at the azimuth of {angle[0] * 0.01:.2f} deg"
    )
    return Opened(revolutions, round(rate * 1e9 / TURN, 3), model.lasers, model.name)


def _factory(path: Path, datagrams: Packets, which: Integers) -> tuple[VelodyneModel, int]:
    mode, number = (int(v) for v in datagrams.bytes_at(which[:1], (1204, 1205))[0])
    if mode not in RETURNS or number not in MODELS:
        known = ", ".join(model.name for model in MODELS.values())
        raise InputError(
            f"{path}: its Velodyne packets end in {mode:#04x} {number:#04x}, which is no return mode and model that is known; "
            f"{known} are; of others the driver makes PointCloud2"
        )
    return MODELS[number], mode


# A packet that comes a day after the one before belongs to another capture.
_LONGEST_NS = 86_400 * 10**9


def _absolute(past_hour_us: Integers, captured_ns: Integers, voice: Voice) -> Integers:
    """Times of the sensor's clock, which tells the hour's microseconds, in ns with the hour that the capture tells.

    A sensor without satellites counts from another minute: by how much is found in the first packet and stays.
    """
    within = past_hour_us * 1000
    apart = int((within[0] - captured_ns[0] + _HOUR_NS // 2) % _HOUR_NS - _HOUR_NS // 2)
    hours = np.round((captured_ns + apart - within) / _HOUR_NS).astype(np.int64)
    if abs(apart) >= _SAID_NS:
        voice.notes.append(f"the sensor's clock is {apart * 1e-9:+.3f} s from the capture's: it is kept")
    return within + hours * _HOUR_NS


def _unwrapped(path: Path, angle: Integers, times_ns: Integers) -> tuple[Integers, float]:
    """Azimuths from the first, 0.01 deg, and the rate, 0.01 deg/ns; lost packets are bridged by the rate."""
    steps, spans = np.diff(angle) % TURN, np.diff(times_ns)
    if len(spans) and float(np.abs(spans.astype(np.float64)).max()) > _LONGEST_NS:
        raise InputError(f"{path}: the times of its packets leap by days: the capture is damaged")
    rate = float(np.median(steps / spans)) if len(steps) else 0.0
    if rate <= 0:
        raise InputError(f"{path}: the sensor does not turn in its {len(angle)} packets")
    turned = np.round((rate * spans - steps) / TURN).astype(np.int64)
    azimuth = np.concatenate([[0], np.cumsum(np.maximum(steps + TURN * turned, 0))])
    # Over the whole of the capture the rounding of azimuths does not count.
    return azimuth, float(azimuth[-1] / (times_ns[-1] - times_ns[0]))
