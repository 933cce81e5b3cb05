"""Point classes beside the scans: `labels/<stem>.label`, as in SemanticKITTI. They are read only when needed."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

from lslam.core.errors import InputError
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence, SequenceView, readable
from lslam.io.formats.point_cloud import LABEL_NAMES
from lslam.io.formats.point_files import LABELS, read_labels

# Scans of which one has labels, or the recording has none: the first that can be read.
_LOOKED_AT = 5


class Labelled(SequenceView):
    """Sequence whose scans get labels from files where their points have none; all else is unchanged."""

    def __init__(self, whole: Sequence, folder: Path, scans: list[Path]) -> None:
        super().__init__(whole, notes=[*whole.notes, f"labels of points from {folder}"])
        self._files = [folder / f"{scan.stem}.label" for scan in scans]

    def scan(self, index: int) -> Scan:
        """Read scan `index` and its labels.

        Labels that are missing or do not match are reported. Raises InputError as the sequence does.
        """
        scan = self.whole.scan(index)
        if scan.labels is not None or not len(scan):
            return scan
        try:
            return replace(scan, labels=read_labels(self._files[index], len(scan)))
        except InputError as error:
            return replace(scan, fault="; ".join(filter(None, (scan.fault, str(error)))))


def labelled(sequence: Sequence) -> Sequence:
    """Sequence with point labels from files beside its scans, if there are any."""
    files: list[Path] = getattr(sequence, "files", [])
    folder = sequence.path / LABELS
    # Where LiDARs are merged, or some scans chosen, the files are of other scans.
    is_whole = len(files) == len(sequence) and not hasattr(sequence, "further_lidars")
    return Labelled(sequence, folder, files) if is_whole and folder.is_dir() else sequence


def with_labels(sequence: Sequence, key: str) -> Sequence:
    """Sequence with point labels. Raises InputError where it has none, naming the `key` that needs them."""
    whole = labelled(sequence)
    scans = [scan for _, scan in islice(readable(range(len(whole)), whole.scan), _LOOKED_AT)]
    if scans and all(scan.labels is None for scan in scans):
        why = f" ({scans[0].fault})" if whole is not sequence else ""
        raise InputError(
            f"{sequence.path}: {key} needs labels of points, and its first scans have none{why}; they are read from "
            f"{LABELS}/*.label beside the scans and from fields {', '.join(LABEL_NAMES[:3])} and the like"
        )
    return whole
