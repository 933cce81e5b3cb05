"""Presets: named TOML files under a configuration. They ship as package data; `--preset FILE` takes one of the user's."""

from __future__ import annotations

import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

from lslam.errors import ConfigError, InputError, UsageError, cause, nearest
from lslam.untrusted import is_file, parse_toml

FOLDER = "presets"
# A preset may say what it is, and on which other one it stands, on a line each beside its sections.
SUMMARY, BASE = "summary", "base"


def known_presets() -> dict[str, str]:
    """Names and one-line summaries of the presets that ship with lslam."""
    return {name: str(parse_toml(text).get(SUMMARY, "")) for name, text in _shipped().items()}


def read_preset(name: str) -> dict[str, Any]:
    """Sections of a preset, and its `base` if it has one: a shipped name, or a TOML file of the user's.

    Raises UsageError with the nearest name when there is none, InputError or ConfigError for an unusable file.
    """
    shipped = _shipped()
    if name in shipped:
        tree = parse_toml(shipped[name])
    elif name.endswith(".toml") or is_file(name):
        tree = read_toml(Path(name), "preset")
    else:
        raise UsageError(f"no preset {name!r} and no TOML file; {nearest(name, shipped)}")
    tree.pop(SUMMARY, None)
    return tree


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """A TOML file as a dictionary. Raises InputError when it cannot be read, ConfigError when it is no TOML."""
    try:
        return parse_toml(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{what} {path} cannot be read: {cause(error)}") from None
    except UnicodeDecodeError:
        raise InputError(f"{what} {path} cannot be read: it is not UTF-8 text") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{what} {path} is not valid TOML: {error}") from None


def _shipped() -> dict[str, str]:
    """Text of each shipped preset by name, in alphabetical order."""
    folder = resources.files("lslam.config") / FOLDER
    files = sorted(
        (f for f in (folder.iterdir() if folder.is_dir() else ()) if f.name.endswith(".toml")), key=lambda f: f.name
    )
    return {f.name.removesuffix(".toml"): f.read_text(encoding="utf-8") for f in files}
