"""Studies by name or file."""

from __future__ import annotations

from pathlib import Path

from lslam.core.config.config import read_package_files
from lslam.core.config.study import StudyConfig, parse_study, read_study
from lslam.core.errors import UsageError, nearest
from lslam.core.untrusted import parse_toml


def study_names() -> tuple[str, ...]:
    """Names of the studies that ship with lslam: those of Girolimetto's chapter 5.3."""
    return tuple(sorted(read_package_files("lslam.studies", "ready")))


def find_study(word: str) -> StudyConfig:
    """The study of a TOML file, else the ready one of that name.

    Raises UsageError with the nearest name for what is neither, and what `read_study` raises.
    """
    if word.endswith(".toml") or Path(word).is_file():
        return read_study(Path(word))
    if word not in study_names():
        raise UsageError(f"no study {word!r} and no TOML file; {nearest(word, study_names())}")
    return parse_study(parse_toml(read_package_files("lslam.studies", "ready")[word]), f"study {word!r}", word)
