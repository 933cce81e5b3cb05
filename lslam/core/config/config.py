"""The whole configuration: its sections, the units of its keys, and how defaults, file, environment and `--set` make it."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from lslam.core.config.backend import (
    DebugConfig,
    GnssConfig,
    GraphConfig,
    KeyframesConfig,
    LocalizeConfig,
    LoopsConfig,
    OsmConfig,
)
from lslam.core.config.odometry import FrontEndConfig
from lslam.core.config.outputs import EvalConfig, MapConfig, ReportConfig
from lslam.core.errors import ConfigError, InputError, UsageError, cause, nearest
from lslam.core.printable import toml_text
from lslam.core.untrusted import is_file, parse_toml

# A preset may say what it is, and on which other one it stands, on a line each beside its sections.
SUMMARY, BASE = "summary", "base"
Tree = dict[str, Any]


class Config(FrontEndConfig):
    """All sections; the defaults are one configuration for every sensor."""

    keyframes: KeyframesConfig = KeyframesConfig()
    loops: LoopsConfig = LoopsConfig()
    graph: GraphConfig = GraphConfig()
    localize: LocalizeConfig = LocalizeConfig()
    gnss: GnssConfig = GnssConfig()
    osm: OsmConfig = OsmConfig()
    map: MapConfig = MapConfig()
    eval: EvalConfig = EvalConfig()
    report: ReportConfig = ReportConfig()
    debug: DebugConfig = DebugConfig()


_UNIT = re.compile(r"((?:%|deg|rad|m2?|s)(?:/(?:100 m|m|s2?))?(?: per sqrt\((?:s|Hz)\))?); ")


def unit_of(key: str) -> str:
    """The unit of `section.key`; empty where it has none, or is no key.

    >>> unit_of("map.voxel"), unit_of("graph.drift_deg_per_100m"), unit_of("input.skip_frames")
    ('m', 'deg/100 m', '')
    """
    section, _, name = key.partition(".")
    known = Config.model_fields.get(section)
    fields = getattr(known.annotation, "model_fields", {}) if known else {}
    found = _UNIT.match(fields[name].description or "") if name in fields else None
    return found[1] if found else ""


def with_unit(key: str, label: str = "") -> str:
    """Label of axes and columns for a key: the key, or `label`, with the unit if there is one.

    >>> with_unit("map.voxel"), with_unit("map.voxel", "voxel"), with_unit("input.skip_frames")
    ('map.voxel, m', 'voxel, m', 'input.skip_frames')
    """
    return ", ".join(filter(None, (label or key, unit_of(key))))


def known_presets() -> dict[str, str]:
    """Names and one-line summaries of the presets that ship with lslam."""
    return {name: str(parse_toml(text).get(SUMMARY, "")) for name, text in _presets().items()}


def read_preset(name: str) -> dict[str, Any]:
    """Sections of a preset, and its `base` if it has one: a shipped name, or a TOML file of the user's.

    Raises UsageError with the nearest name when there is none, InputError or ConfigError for an unusable file.
    """
    presets = _presets()
    if name in presets:
        tree = parse_toml(presets[name])
    elif name.endswith(".toml") or is_file(name):
        tree = read_toml(Path(name), "preset")
    else:
        raise UsageError(f"no preset {name!r} and no TOML file; {nearest(name, presets)}")
    tree.pop(SUMMARY, None)
    return tree


def _presets() -> dict[str, str]:
    """TOML text of the presets that ship with lslam, by name."""
    return read_package_files("lslam.core.config", "presets")


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


@cache
def read_package_files(package: str, folder: str) -> dict[str, str]:
    """Text of each TOML file that ships in a folder of a package of ours by name, in the order of the files."""
    files = sorted(resources.files(package).joinpath(folder).iterdir(), key=lambda file: file.name)
    return {f.name.removesuffix(".toml"): f.read_text(encoding="utf-8") for f in files if f.name.endswith(".toml")}


def load_config(
    path: Path | None = None, settings: Iterable[str] = (), environ: Mapping[str, str] | None = None
) -> Config:
    """Resolve the configuration: `settings` ("a.b=v") over LSLAM_A_B variables over the TOML file over defaults.

    Whoever of them names `odometry.preset` puts that preset between the file and the defaults. Raises ConfigError naming
    the key and the nearest known one, UsageError for an unknown preset, InputError when a file is missing.
    """
    tree: Tree = {}
    if path is not None:
        _merge(tree, read_toml(path, "configuration"), str(path), is_file=True)
    _merge(tree, _from_environment(os.environ if environ is None else environ), "environment")
    for setting in settings:
        _merge(tree, _parse_setting(setting), f"--set {setting}")
    try:
        return Config.model_validate(_over_preset(tree))
    except ValidationError as error:
        raise ConfigError(explain(error)) from None


def check_settings(settings: Iterable[str]) -> None:
    """Raise ConfigError for a setting ("a.b=v") that names no key. Values are checked by `load_config`."""
    for setting in settings:
        _merge({}, _parse_setting(setting), f"--set {setting}")


def _over_preset(tree: Tree) -> Tree:
    """The tree merged over the preset it names; a preset's file is stored as an absolute path, so that a copy finds it."""
    name = str(tree.get("odometry", {}).get("preset", ""))
    if not name:
        return tree
    under = _whole(name)
    _merge(under, tree, "")
    under["odometry"]["preset"] = name if name in known_presets() else str(Path(name).resolve())
    return under


def _whole(name: str, above: tuple[str, ...] = ()) -> Tree:
    """Preset merged over its `base`; above : presets that led to it.

    Raises ConfigError for a cycle, unknown keys, and a base that is stated as odometry.preset.
    """
    if name in above:
        raise ConfigError(f"presets {', '.join(above)}: one cannot stand on itself")
    tree = read_preset(name)
    base = tree.pop(BASE, None)
    under = {} if base is None else _whole(str(base), (*above, name))
    _merge(under, tree, f"preset {name}", is_file=True)
    if "preset" in under.get("odometry", {}):
        raise ConfigError(
            f'preset {name}: what it stands on is said by base = "NAME" at its top, not by odometry.preset'
        )
    return under


def to_toml(config: Config) -> str:
    """The resolved configuration as TOML; absent optional values are left out."""
    return toml_text(config.model_dump(mode="json", exclude_none=True))


def to_described_toml(config: Config) -> str:
    """The configuration as TOML, every key on one line with its description; absent optional values are commented out."""
    lines: list[str] = []
    for section in type(config).model_fields:
        values = getattr(config, section)
        lines += [""] * bool(lines) + [f"[{section}]"]
        for key, value in values.model_dump(mode="json").items():
            text = f"# {key} =" if value is None else f"{key} = {_inline(value)}"
            lines.append(f"{text}  # {type(values).model_fields[key].description}")
    return "\n".join(lines) + "\n"


def _inline(value: Any) -> str:
    """A value as TOML on one line."""
    if isinstance(value, list):
        return f"[{', '.join(_inline(v) for v in value)}]"
    return toml_text({"v": value}).removeprefix("v = ").strip()


def _from_environment(environ: Mapping[str, str]) -> Tree:
    """Tree of the variables of the environment: LSLAM_MAP_VOXEL=0.1 is map.voxel; other variables (LSLAM_DATA) are ignored."""
    tree: Tree = {}
    for name in sorted(environ):
        if not name.startswith("LSLAM_"):
            continue
        section, _, key = name.removeprefix("LSLAM_").lower().partition("_")
        if section in Config.model_fields and key:
            tree.setdefault(section, {})[key] = setting_value(environ[name])
    return tree


def _parse_setting(setting: str) -> Tree:
    """Tree of one setting "section.key=value"; raises ConfigError for text of another form."""
    name, equals, value = setting.partition("=")
    section, dot, key = name.strip().partition(".")
    if not equals or not dot:
        raise ConfigError(f"--set {setting}: expected section.key=value, for example map.voxel=0.1")
    return {section: {key: setting_value(value.strip())}}


def setting_value(text: str) -> Any:
    """A TOML value, or the text itself when it is none: `--set odometry.method=icp` needs no quotes."""
    try:
        return parse_toml(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        return text


def _merge(tree: Tree, more: Tree, where: str, *, is_file: bool = False) -> None:
    """Override keys of `tree` by those of `more`; raises ConfigError naming `where` for unknown ones.

    is_file : accept former keys with their fixed value, as the config.toml of an earlier run has them
    """
    for section, values in more.items():
        if section not in Config.model_fields and section not in former_keys():
            raise ConfigError(f"{where}: unknown section {section!r}; {nearest(section, Config.model_fields)}")
        if not isinstance(values, dict):
            raise ConfigError(f"{where}: {section!r} is a section, write {section}.key = value")
        keys = _keys_of(section)
        for key, value in values.items():
            if key in keys:
                tree.setdefault(section, {})[key] = value
                continue
            former = former_keys().get(section, {}).get(key)
            if former is None:
                raise ConfigError(f"{where}: unknown key {section}.{key}; {nearest(key, keys)}")
            if not is_file or value != former.get("value"):
                raise ConfigError(f"{where}: there is no {section}.{key} any more: {_outcome(**former)}")


def _keys_of(section: str) -> tuple[str, ...]:
    """The keys of a section; none of one of earlier versions."""
    if section not in Config.model_fields:
        return ()
    model = Config.model_fields[section].annotation
    assert isinstance(model, type)
    assert issubclass(model, BaseModel)
    return tuple(model.model_fields)


@cache
def former_keys() -> dict[str, dict[str, dict[str, Any]]]:
    """Keys of earlier versions by section: the value that they have in all runs now, or what became of them."""
    return parse_toml(resources.files("lslam.core.config").joinpath("former_keys.toml").read_text(encoding="utf-8"))


def _outcome(outcome: str = "", value: Any = None, instead: str = "") -> str:
    """Sentence for users: what became of a key of an earlier version, and what to do instead.

    outcome : the whole sentence, if given; value : that the key has in all runs now; instead : the setting that replaces it
    """
    way_out = f"turn {instead} instead" if instead else "leave the key out"
    return outcome or f"it is {value} in all runs; {way_out}"


def explain(error: ValidationError, where: str = "configuration") -> str:
    """Sentence with one part per key: the value, what is expected, and the nearest of the allowed words."""
    parts: dict[str, str] = {}
    found = error.errors()
    for e in found:
        # Items that are wrong themselves are missing from a list, which is no fault of its own.
        if e["type"] == "too_short" and any(
            other is not e and other["loc"][: len(e["loc"])] == e["loc"] for other in found
        ):
            continue
        # What follows two names is a choice of types, except in a table of a table's list.
        names = 3 if [isinstance(p, int) for p in e["loc"][:5]] == [False, True, False, True, False] else 2
        key = ".".join([str(p) for p in e["loc"] if not isinstance(p, int)][:names])
        wanted = e["msg"].removeprefix("Value error, ")
        if e["type"] == "literal_error":
            words = re.findall(r"'([^']*)'", e["ctx"]["expected"])
            wanted += f"; {nearest(str(e['input']), words)}" if len(words) > 1 else ""
        # What concerns several keys of a section names them itself; a choice of types complains once per type.
        tables = e["input"] if isinstance(e["input"], (list, tuple)) else [e["input"]]
        said = (
            f"{key}: {wanted}"
            if any(isinstance(table, dict) for table in tables)
            else f"{key} = {e['input']!r}: {wanted}"
        )
        if key not in parts:
            parts[key] = said
        # Who wrote a table did not mean a list.
        elif wanted not in parts[key] and not (e["type"] == "tuple_type" and isinstance(e["input"], dict)):
            parts[key] += f", or {wanted}"
    return f"{where}: " + "; ".join(parts.values())
