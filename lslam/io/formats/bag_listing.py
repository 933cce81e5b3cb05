"""Bag files on disk: which files are bags, which belong to one recording, and which parts are missing."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from lslam.core.printable import first_of

SUFFIXES = (".bag", ".bag.active", ".mcap", ".db3")
# Endings of files that were compressed as a whole, as recorders and people do.
COMPRESSIONS = {".zstd": "zstd", ".zst": "zstd", ".lz4": "lz4", ".gz": "gz", ".bz2": "bz2", ".xz": "xz"}
# Captures of the packets of a sensor.
CAPTURES = (".pcap", ".pcapng")
METADATA = "metadata.yaml"
# Recorders of ROS 1 put the time at which a part begins before its number.
_TIME = re.compile(r"\d{4}([-_]\d\d){5}")
_NUMBER = re.compile(r"(?:(.*?)[_-])?(\d{1,4})$")
# Beside a database SQLite keeps these; they hold no recording of their own.
_COMPANIONS = ("-wal", "-shm", "-journal")


def holds_recording(path: Path) -> bool:
    """Whether the path, or a file in this folder, ends as bags or captures do, whatever it may be."""
    names = [p.name for p in path.iterdir()] if path.is_dir() else [path.name]
    return any(suffix_of(Path(name)) or name.lower().endswith(CAPTURES) for name in names)


def list_bag_files(path: Path) -> list[Path]:
    """The file itself, or the bag files of a folder in natural order; empty when there are none.

    If a part is there both plain and compressed, only the first is listed.
    """
    if path.is_file():
        return [path] if suffix_of(path) else []
    if not path.is_dir():
        return []
    files = [p for p in path.iterdir() if suffix_of(p) and p.is_file() and not p.name.startswith(".")]
    plain = {p.name for p in files}
    return sorted(
        (p for p in files if p.name == _unpack_name(p.name) or _unpack_name(p.name) not in plain), key=_natural
    )


def left_out(path: Path, files: list[Path]) -> list[str]:
    """Sentences about files in the folder `path` that look like parts of the recording but are not read."""
    if not path.is_dir():
        return []
    names = {p.name for p in files}
    sentences = []
    for name in sorted(p.name for p in path.iterdir() if p.name[0] != "."):
        if name in names or name.endswith(_COMPANIONS):
            continue
        if _unpack_name(name) in names:
            sentences.append(f"{name} is left out: {_unpack_name(name)} is the same part, not compressed")
        elif inner := next((s for s in SUFFIXES if f"{s}." in name.lower()), None):
            ending = name.lower().rpartition(f"{inner}.")[2]
            sentences.append(f"{name} is not read: .{ending} is no ending of a bag nor of a compression that is known")
    return sentences


def missing_parts(path: Path, files: list[Path]) -> list[str]:
    """Sentences about missing parts, judged by the numbers in the names and by `metadata.yaml`."""
    sentences = []
    series: dict[str, dict[int, Path]] = {}
    for file in files:
        if (own := _part_number(file)) is not None:
            series.setdefault(own[0], {})[own[1]] = file
    for name, numbers in series.items():
        have = sorted(numbers)
        missing = sorted(set(range(have[0], have[-1])) - set(have))
        # More numbers missing than there are: they count something else, days or minutes.
        if 0 < len(missing) <= 10 * len(have):
            which = f"part {missing[0]} is" if len(missing) == 1 else f"parts {first_of(missing)} are"
            sentences.append(
                f"{which} missing: the parts in {path} are numbered from {have[0]} ({numbers[have[0]].name}) to "
                f"{have[-1]} ({numbers[have[-1]].name})"
            )
        # ROS 2 counts from 0 and calls the parts as their folder.
        first = 0 if name == path.name else 1
        if have[0] > first and (len(have) > 1 or first == 0):
            sentences.append(f"the first part in {path} is {numbers[have[0]].name}: those before it are missing")
    return sentences + _missing_by_metadata(path, files)


def parts_beside(path: Path) -> list[Path]:
    """Other parts of a split recording: files beside `path` whose names differ only in the number at the end."""
    own = _part_number(path)
    if own is None:
        return []
    beside = (p for p in path.parent.iterdir() if suffix_of(p) and p != path and p.is_file())
    return sorted((p for p in beside if (m := _part_number(p)) and m[0] == own[0] and m[1] != own[1]), key=_natural)


def suffix_of(path: Path) -> str:
    """The suffix that makes a file a bag, compressed or not, empty when it is none."""
    name = _unpack_name(path.name.lower())
    return next((s for s in SUFFIXES if name.endswith(s)), "")


def packing_of(path: Path) -> str:
    """How a file is compressed as a whole, by its name; empty where it is not."""
    return next((kind for ending, kind in COMPRESSIONS.items() if path.name.lower().endswith(ending)), "")


def stem_of(path: Path) -> str:
    """Name of a file without its bag suffix and its compression suffix."""
    return _unpack_name(path.name)[: -len(suffix_of(path)) or None]


def _unpack_name(name: str) -> str:
    """The name without the suffix of a compression of the whole file."""
    ending = next((e for e in COMPRESSIONS if name.lower().endswith(e)), "")
    return name[: len(name) - len(ending)]


def _part_number(path: Path) -> tuple[str, int] | None:
    """Common name of all parts of a recording, and the number of this part; None where the name has none."""
    stem = _TIME.sub("", stem_of(path))
    match = _NUMBER.search(stem)
    return None if match is None or not match[1] else (match[1].rstrip("_-"), int(match[2]))


def _missing_by_metadata(path: Path, files: list[Path]) -> list[str]:
    """A sentence, in a list, on files that ROS 2's `metadata.yaml`, of any version, lists but that are missing.

    Empty without such, and where the file cannot be read.
    """
    if not path.is_dir() or not (path / METADATA).is_file():
        return []
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        tree: Any = YAML(typ="safe", pure=True).load((path / METADATA).read_text(errors="replace"))
        listed = [str(name) for name in tree["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (YAMLError, LookupError, TypeError, ValueError, RecursionError, OSError):
        return []
    names = {_unpack_name(p.name) for p in files}
    absent = [name for name in (one.rpartition("/")[2] for one in listed) if _unpack_name(name) not in names]
    if not absent:
        return []
    are = "is" if len(absent) == 1 else "are"
    return [f"{path / METADATA} lists {len(listed)} files, of which {first_of(absent)} {are} not there"]


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key with numbers compared as numbers: part_2 before part_10."""
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in re.split(r"(\d+)", path.name)]
