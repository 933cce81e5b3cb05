"""Satellite position fixes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class GnssStream:
    """Fixes of one receiver.

    stamps_ns : (M,) int64; lat_lon_alt : (M, 3) float64, deg, deg, m (WGS84); sigma : (M,) float64 one-sigma, m
    """

    stamps_ns: NDArray[np.int64]
    lat_lon_alt: NDArray[np.float64]
    sigma: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def is_place(self) -> NDArray[np.bool_]:
        """(M,) whether each fix is a place on the Earth; receivers without one write zeros."""
        lat, lon = self.lat_lon_alt[:, 0], self.lat_lon_alt[:, 1]
        finite = np.isfinite(self.lat_lon_alt).all(axis=1)
        return np.asarray(finite & (np.abs(lat) <= 90) & (np.abs(lon) <= 180) & ((lat != 0) | (lon != 0)))
