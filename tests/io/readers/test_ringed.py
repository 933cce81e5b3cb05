"""A sequence whose scans get their rings, and what a run says about it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lslam.core.config import load_config
from lslam.core.errors import InputError
from lslam.core.types.scan import NO_RING, Scan
from lslam.pipeline.job import choose_scans
from lslam.registration.preprocessing.views import with_rings
from lslam.simulation.scenarios import SimulatedDrive, simulate


class Bare:
    """A simulated drive without ring field, unless `with_fields`; what `change` makes of each scan."""

    def __init__(self, drive: SimulatedDrive, change: Any = lambda scan: scan, with_fields: bool = False) -> None:
        self._drive, self._change, self._with_fields = drive, change, with_fields

    def __getattr__(self, name: str) -> Any:
        return getattr(self._drive, name)

    def __len__(self) -> int:
        return len(self._drive)

    def scan(self, index: int) -> Scan:
        scan = self._drive.scan(index)
        changed: Scan = self._change(scan if self._with_fields else replace(scan, rings=None))
        return changed


def bare(change: Any = lambda scan: scan, with_fields: bool = False) -> Any:
    return Bare(simulate("block", seed=0, count=12), change, with_fields)


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
    plain = choose_scans(bare(), SimpleNamespace(needs_rings=False), config)  # type: ignore[arg-type]
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


def test_points_without_a_ring_leave_the_scans_of_methods_that_need_rings() -> None:
    def some(scan: Scan) -> Scan:
        assert scan.rings is not None
        return replace(scan, rings=np.where(np.arange(len(scan)) % 50, scan.rings, NO_RING).astype(np.uint16))

    whole = bare(some, with_fields=True)
    ringed = with_rings(whole)
    assert ringed.notes[-1] == "rings: 16, the ring field of the points"
    kept = np.arange(len(whole.scan(3))) % 50 > 0
    np.testing.assert_array_equal(ringed.scan(3).points, whole.scan(3).points[kept])
    np.testing.assert_array_equal(ringed.scan(3).rings, whole.scan(3).rings[kept])


@pytest.mark.parametrize("odd", [0, 6])
def test_a_scan_without_the_ring_field_has_its_rings_found_by_itself(odd: int) -> None:
    """The first one too, and a sliver does not decide how rings are found."""
    whole = bare(lambda scan: replace(scan, rings=None) if scan.index == odd else scan, with_fields=True)
    ringed = with_rings(whole)
    assert ringed.notes[-1] == "rings: 16, the ring field of the points"
    assert ringed.scan(3).fault == ""
    scan = ringed.scan(odd)
    assert f"scan {odd} has no ring field" in scan.fault
    assert scan.rings is not None
    assert len(np.unique(scan.rings)) == 16


def test_a_sliver_at_the_beginning_does_not_decide_the_order() -> None:
    whole = bare(lambda scan: scan.select(np.arange(len(scan)) > 0.98 * len(scan)) if scan.index == 0 else scan)
    assert with_rings(whole).scan(2).rings is not None
