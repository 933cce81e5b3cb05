"""Lookup of a sequence by what the user typed: a path, or a name under the data root."""

from __future__ import annotations

import difflib
import os
import re
from pathlib import Path

from lslam.core.errors import InputError
from lslam.io.formats.bag_listing import CAPTURES, SUFFIXES, list_bag_files
from lslam.io.remote import RemotePath, as_path

_SEQUENCE = re.compile(r"(?:.*/)?(?:seq)?(\d{1,2})$")
_DRIVE_NAME = re.compile(r"(?:(?P<date>\d{4}_\d\d_\d\d)_)?(?:drive_)?(?P<number>\d{4})(?P<kind>_sync|_extract)?$")
DRIVE = re.compile(r"(?P<date>\d{4}_\d\d_\d\d)_drive_(?P<number>\d{4})(?P<kind>_sync|_extract)?$")
_ROOTS = ("", "dataset", "kitti", "kitti/dataset", "raw", "kitti_raw", "kitti/raw")


def find_folder(name_or_path: str | Path, data_root: Path | None = None) -> Path:
    """Folder or bag of a sequence: `name_or_path` itself if it exists, else the name looked up under `data_root`.

    `data_root` is LSLAM_DATA when None; the current folder comes after it. `seq07`, `07` and `kitti/07` find `sequences/07`
    and folders of those names; a drive is found by its name, by `drive_0005` or `0005` when only one has it.
    Raises InputError naming where it looked and names that are near.
    """
    text = str(name_or_path)
    path = as_path(name_or_path).expanduser()
    if path.is_dir() or is_recording(path):
        return path
    if path.exists():
        known = ", ".join("*" + suffix for suffix in (*SUFFIXES, *CAPTURES))
        raise InputError(
            f"{path} is a file: give a bag or a capture ({known}) or the folder of the sequence (a KITTI "
            "sequence, a raw drive, or its scans)"
        )
    if isinstance(path, RemotePath):
        raise InputError(f"no sequence {text!r}: no such bucket, object or folder")
    if data_root is None and os.environ.get("LSLAM_DATA"):
        data_root = Path(os.environ["LSLAM_DATA"])
    here = Path.cwd()
    places = [here]
    if data_root is not None:
        root = data_root.expanduser()
        if not root.is_dir():
            raise InputError(f"no sequence {text!r}: the data root {root} does not exist")
        if (root / text).is_dir() or is_recording(root / text):
            return root / text
        places = [root, here]
    matches = next((m for place in places if (m := _sequences(place, text) or _drives(place, text))), [])
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise InputError(f"{text!r} may be any of {', '.join(str(p) for p in matches)}: name one of them")
    if data_root is not None:
        raise InputError(_not_found(text, places[0]))
    raise InputError(
        f"no sequence {text!r}: {path} does not exist, nor is it in {here}; names such as seq07 need --data-root or "
        "LSLAM_DATA where their data set is elsewhere"
    )


def is_recording(path: Path) -> bool:
    """Whether `path` is a bag, a folder of its parts, or a packet capture."""
    return bool(list_bag_files(path)) or (path.suffix.lower() in CAPTURES and path.is_file())


def sequence_number(name: str) -> str:
    """Number of a KITTI odometry sequence in a name of the user or of a folder; empty when it is none.

    >>> sequence_number("seq07"), sequence_number("kitti/7"), sequence_number("town")
    ('07', '07', '')
    """
    match = _SEQUENCE.match(name)
    return match.group(1).zfill(2) if match else ""


def _sequences(root: Path, text: str) -> list[Path]:
    number = sequence_number(text)
    if not number:
        return []
    folders = [root / part / name for name in (f"sequences/{number}", f"seq{number}", number) for part in _ROOTS]
    return [p for p in folders if p.is_dir()][:1]


def _drives(root: Path, text: str) -> list[Path]:
    wanted = _DRIVE_NAME.match(text.rsplit("/", 1)[-1])
    if not wanted:
        return []
    parts = {name: part for name, part in wanted.groupdict().items() if part is not None}
    return [
        path
        for path in _all_drives(root)
        if (drive := DRIVE.match(path.name)) and parts.items() <= drive.groupdict().items()
    ]


def _all_drives(root: Path) -> list[Path]:
    places = [root, *(p for part in _ROOTS if (p := root / part).is_dir() and part)]
    days = [d for place in places for d in place.glob("[0-9]*_[0-9]*_[0-9]*") if d.is_dir()]
    candidates = [p for place in [*places, *days] for p in place.glob("*_drive_*") if p.is_dir()]
    return sorted({p for p in candidates if DRIVE.match(p.name)})


def _not_found(text: str, root: Path) -> str:
    sequences = [p for part in _ROOTS for p in (root / part / "sequences").glob("*/")]
    folders = [p.name for p in root.glob("*/") if p.name not in ("sequences", "poses")]
    names = sorted({*(f"seq{p.name}" for p in sequences), *(p.name for p in _all_drives(root)), *folders})
    near = difflib.get_close_matches(text, names, n=3, cutoff=0.5) or names[:12]
    hint = f"; there are {', '.join(near)}" if near else "; it is empty"
    return f"no sequence {text!r}: looked for {Path(text)}, {root / text}, sequences/ and raw drives under {root}{hint}"
