"""What an object needs to go on where it was: named arrays and nothing else, so that a file of them cannot run code."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

State = dict[str, NDArray[Any]]


def joined(**parts: State) -> State:
    """The states of several parts as one; names become `part.name`."""
    return {f"{part}.{name}": array for part, state in parts.items() for name, array in state.items()}


def part_of(state: State, part: str) -> State:
    """The state of one part that `joined` put in; empty when there is none.

    >>> import numpy as np
    >>> part_of(joined(a={"x": np.zeros(1)}, b={"y": np.ones(1)}), "b")
    {'y': array([1.])}
    """
    return {name.removeprefix(f"{part}."): array for name, array in state.items() if name.startswith(f"{part}.")}
