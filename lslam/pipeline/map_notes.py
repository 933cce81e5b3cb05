"""`<stem>.json` beside maps: what each file of that stem is. The map written last is told first, others under `others`.

{"schema": "lslam-map", "version": 1, "file": "map.laz", ..., "others": {"map.ply": {"schema": ..., "file": "map.ply", ...}}}
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lslam.errors import OutputError, cause
from lslam.formats.point_files import MAP_SUFFIXES
from lslam.pipeline.json_files import read_json, write_json

Note = dict[str, Any]
SCHEMA = "lslam-map"


def note_of(path: Path) -> Note:
    """What the note beside a map says of it; empty when it says nothing."""
    return _notes(path).get(path.name, {})


def noted_last(path: Path) -> Path | None:
    """The map beside `path`, with its stem, that was written last as the note knows it; None when it knows none."""
    return next((path.with_name(name) for name in _notes(path)), None)


def is_note(path: Path) -> bool:
    """Whether `path` may become a note: a file of this kind, none at all, or one that nobody can read."""
    return bool(read_json(path).get("schema", SCHEMA) == SCHEMA)


def note_with(path: Path, about: Note) -> Note:
    """The note beside `path` when it tells of that map first, and of the others of its stem that are there."""
    return _joined({path.name: about, **{name: note for name, note in _notes(path).items() if name != path.name}})


def drop_note(path: Path) -> None:
    """Tell of the map no more: another is about to take its name. Raises OutputError."""
    notes, target = _notes(path), path.with_suffix(".json")
    if notes.pop(path.name, None) is None:
        return
    if notes:
        write_json(target, _joined(notes))
        return
    try:
        target.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{target} cannot be written: {cause(error)}") from None


def _notes(path: Path) -> dict[str, Note]:
    """By file name, the last written first; files that are gone, and names that are none of a map's, are left out."""
    tree = read_json(path.with_suffix(".json"))
    others = tree.pop("others", None)
    told = {str(tree.get("file")): tree, **(others if isinstance(others, dict) else {})}
    return {
        name: note
        for name, note in told.items()
        if isinstance(note, dict) and _is_of(path, name) and path.with_name(name).is_file()
    }


def _is_of(path: Path, name: str) -> bool:
    other = Path(name)
    return other.name == name and other.stem == path.stem and other.suffix.lower() in MAP_SUFFIXES


def _joined(notes: dict[str, Note]) -> Note:
    first, *others = notes
    return notes[first] | ({"others": {name: notes[name] for name in others}} if others else {})
