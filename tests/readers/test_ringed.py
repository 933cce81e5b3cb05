"""A sequence whose scans get their rings, and what a run says about it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lslam.config import load_config
from lslam.errors import InputError
from lslam.pipeline.job import choose_scans
from lslam.readers.selection import with_rings
from lslam.simulation.scenarios import SimulatedDrive, simulate
from lslam.types.scan import Scan


class Bare:
    """A simulated drive without ring field; what `change` makes of each scan."""

    def __init__(self, drive: SimulatedDrive, change: Any = lambda scan: scan) -> None:
        self._drive, self._change = drive, change

    def __getattr__(self, name: str) -> Any:
        return getattr(self._drive, name)

    def __len__(self) -> int:
        return len(self._drive)

    def scan(self, index: int) -> Scan:
        changed: Scan = self._change(replace(self._drive.scan(index), rings=None))
        return changed


def bare(change: Any = lambda scan: scan) -> Any:
    return Bare(simulate("block", seed=0, count=12), change)


def test_every_scan_gets_its_rings_and_the_notes_say_how() -> None:
    sequence = with_rings(bare())
    truth = simulate("block", seed=0, count=12)
    assert sequence.notes == ["rings: 16, from the azimuth wraps of the file order"]
    for index in (0, 11):
        rings, known = sequence.scan(index).rings, truth.scan(index).rings
        assert rings is not None
        assert known is not None
        assert np.mean(rings == known) > 0.995
    assert with_rings(truth).notes == ["rings: 16, the ring field of the points"]
    assert with_rings(bare(), "elevation").notes == ["rings: 16, from clusters of elevation"]


def test_only_methods_that_need_rings_get_them_and_any_part_of_a_recording_has_the_same_rule() -> None:
    config = load_config(None, ["input.start=5", "input.skip_frames=3", "input.rings=order"], {})
    plain = choose_scans(bare(), SimpleNamespace(), config)  # type: ignore[arg-type]
    assert plain.scan(0).rings is None
    chosen = choose_scans(bare(), SimpleNamespace(needs_rings=True), config)  # type: ignore[arg-type]
    assert [chosen.scan(i).index for i in range(len(chosen))] == [5, 8, 11]
    assert chosen.scan(1).rings is not None
    assert any("file order" in note for note in chosen.notes)


def test_scans_that_cannot_be_read_or_are_empty_do_not_decide() -> None:
    def broken(scan: Scan) -> Scan:
        if scan.index == 0:
            raise InputError("scan 0 is broken")
        return scan.select(slice(0, 0)) if scan.index == 1 else scan

    sequence = with_rings(bare(broken))
    assert sequence.notes[-1].startswith("rings: 16")
    assert len(sequence.scan(1)) == 0


def test_a_recording_without_rings_is_refused_by_name_and_a_scan_that_differs_is_an_error() -> None:
    def shuffled(scan: Scan) -> Scan:
        return scan.select(np.random.default_rng(0).permutation(len(scan)))

    def turned(scan: Scan) -> Scan:
        R = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float32)
        return replace(shuffled(scan), points=shuffled(scan).points @ R)

    with pytest.raises(InputError, match=r"block-0: --rings auto: .* --method loam-livox or icp"):
        with_rings(bare(turned))
    later = with_rings(bare(lambda scan: turned(scan) if scan.index == 7 else scan))
    with pytest.raises(InputError, match="scan 7 is not in ring order"):
        later.scan(7)
