"""Studies by name or file."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from lslam.config.study import StudyConfig, parse_study, read_study
from lslam.errors import UsageError, nearest
from lslam.untrusted import parse_toml

# Studies that ship with lslam.
FOLDER = "ready"


def study_names() -> tuple[str, ...]:
    """Names of the studies that ship with lslam: those of Girolimetto's chapter 5.3."""
    files = resources.files(__package__).joinpath(FOLDER).iterdir()
    return tuple(sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml")))


def find_study(word: str) -> StudyConfig:
    """The study of a TOML file, else the ready one of that name.

    Raises UsageError with the nearest name for what is neither, and what `read_study` raises.
    """
    if word.endswith(".toml") or Path(word).is_file():
        return read_study(Path(word))
    if word not in study_names():
        raise UsageError(f"no study {word!r} and no TOML file; {nearest(word, study_names())}")
    text = resources.files(__package__).joinpath(FOLDER, f"{word}.toml").read_text(encoding="utf-8")
    return parse_study(parse_toml(text), f"study {word!r}", word)
