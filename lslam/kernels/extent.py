"""Smallest and largest of an array: NumPy's own take a third of a second to compile, for each type of number."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from lslam.kernels.jit import inline


@inline
def extent(values: NDArray[Any]) -> tuple[Any, Any]:
    """Least and greatest of the values (N,), N > 0; both are NaN where one of them is, as NumPy has it."""
    low = high = values[0]
    for value in values:
        # NaN is what differs from itself; nothing is smaller or larger than it, so that it stays.
        if value < low or value != value:
            low = value
        if value > high or value != value:
            high = value
    return low, high
