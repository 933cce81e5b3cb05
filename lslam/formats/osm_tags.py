"""What tags of OpenStreetMap say about a building: how high it is, where it begins, whether it can be seen."""

from __future__ import annotations

import re
from collections.abc import Mapping

STOREY = 3.0  # m, docs/conventions.md
FOOT = 0.3048  # m
TALLEST = 1000.0  # m; what is higher is a slip of the pen


def height_of(tags: Mapping[str, str]) -> float | None:
    """Height in m from `height` (m, or feet and inches), else `building:levels` x 3 m; None when neither is a sensible number."""
    height = _length(tags.get("height", ""))
    if height is None:
        levels = _number(tags.get("building:levels", ""))
        height = None if levels is None else levels * STOREY
    return height if height is not None and 0 < height < TALLEST else None


def base_of(tags: Mapping[str, str]) -> float:
    """Where the walls begin, m above the ground: `min_height`, else `building:min_level` x 3 m, else 0.

    What lies above the building's own height is nonsense and counts as 0.
    """
    base = _length(tags.get("min_height", ""))
    if base is None:
        base = (_number(tags.get("building:min_level", "")) or 0.0) * STOREY
    return base if 0 < base < (height_of(tags) or TALLEST) else 0.0


def is_underground(tags: Mapping[str, str]) -> bool:
    """True for `location=underground` and for a negative `layer`."""
    layer = _number(tags.get("layer", ""))
    return tags.get("location") == "underground" or (layer is not None and layer < 0)


def _number(text: str) -> float | None:
    found = re.fullmatch(r"\s*([+-]?\d+(?:[.,]\d+)?)\s*", text)
    return float(found[1].replace(",", ".")) if found else None


def _length(text: str) -> float | None:
    """Metres from `12`, `12.5 m`, `40 ft` or `40'6"`."""
    found = re.fullmatch(r"\s*(\d+(?:[.,]\d+)?)\s*(m|metres?|meters?|ft|feet|')?\s*(?:(\d+(?:\.\d+)?)\")?\s*", text)
    if not found or (found[3] and found[2] != "'"):
        return None
    value = float(found[1].replace(",", "."))
    return value * FOOT + float(found[3] or 0) * FOOT / 12 if found[2] in ("ft", "feet", "'") else value
