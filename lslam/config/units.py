"""The unit of a configuration key: the word before the first semicolon of its description, where that is a unit."""

from __future__ import annotations

import re

from lslam.config.config import Config

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


def with_unit(key: str, shown: str = "") -> str:
    """A key, or what is shown in its place, as axes and columns name it.

    >>> with_unit("map.voxel"), with_unit("map.voxel", "voxel"), with_unit("input.skip_frames")
    ('map.voxel, m', 'voxel, m', 'input.skip_frames')
    """
    return ", ".join(filter(None, (shown or key, unit_of(key))))
