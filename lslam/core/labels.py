"""Classes of points: SemanticKITTI's numbers and names. Recordings that number other classes have no names for them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

CLASSES = {
    "unlabeled": 0,
    "outlier": 1,
    "car": 10,
    "bicycle": 11,
    "bus": 13,
    "motorcycle": 15,
    "on-rails": 16,
    "truck": 18,
    "other-vehicle": 20,
    "person": 30,
    "bicyclist": 31,
    "motorcyclist": 32,
    "road": 40,
    "parking": 44,
    "sidewalk": 48,
    "other-ground": 49,
    "building": 50,
    "fence": 51,
    "other-structure": 52,
    "lane-marking": 60,
    "vegetation": 70,
    "trunk": 71,
    "terrain": 72,
    "pole": 80,
    "traffic-sign": 81,
    "other-object": 99,
    "moving-car": 252,
    "moving-bicyclist": 253,
    "moving-person": 254,
    "moving-motorcyclist": 255,
    "moving-on-rails": 256,
    "moving-bus": 257,
    "moving-truck": 258,
    "moving-other-vehicle": 259,
}
MOVING = "moving"  # every class whose name begins so
# Classes of LAS by the ASPRS, and what they hold of SemanticKITTI's; 64 is the first that users define. Others are 1, unlabelled
# points 0.
ASPRS = {
    2: ("road", "parking", "sidewalk", "other-ground", "lane-marking", "terrain"),
    6: ("building", "fence", "other-structure"),
    5: ("vegetation", "trunk"),
    64: (MOVING,),
}
_VALUES = 1 << 16


def parse_classes(value: Any) -> tuple[str, ...]:
    """Names and numbers of classes from a list, or from text with commas between. Raises ValueError for one that is unknown.

    >>> parse_classes([252, "car"]), parse_classes("moving, 30")
    (('252', 'car'), ('moving', '30'))
    """
    words = value.split(",") if isinstance(value, str) else value if isinstance(value, list | tuple) else [value]
    names = tuple(str(word).strip() for word in words if word != "")
    numbers_of(names)
    return names


def numbers_of(names: Iterable[str]) -> set[int]:
    """Numbers of the classes `names`, which may be numbers themselves; `moving` is all that move.

    Raises ValueError for an unknown one.
    """
    numbers: set[int] = set()
    for name in names:
        if name.isdecimal() and int(name) < _VALUES:
            numbers.add(int(name))
        elif name == MOVING:
            numbers |= {number for known, number in CLASSES.items() if known.startswith(MOVING)}
        elif name in CLASSES:
            numbers.add(CLASSES[name])
        else:
            known = ", ".join([*CLASSES, MOVING])
            raise ValueError(f"{name!r} is no class of points: a number from 0 to {_VALUES - 1}, or one of {known}")
    return numbers


def table_of(names: Iterable[str]) -> NDArray[np.bool_]:
    """(65536,) whether a label is one of the classes that are named."""
    # The configuration is checked before anything heavy is imported.
    import numpy as np

    table = np.zeros(_VALUES, np.bool_)
    table[sorted(numbers_of(names))] = True
    return table


def asprs_table() -> NDArray[np.uint8]:
    """(65536,) ASPRS class, as LAS has them, of each label; 1 for labels without one, 0 for unlabelled points."""
    import numpy as np

    table = np.ones(_VALUES, np.uint8)
    table[CLASSES["unlabeled"]] = 0
    for number, names in ASPRS.items():
        table[sorted(numbers_of(names))] = number
    return table
