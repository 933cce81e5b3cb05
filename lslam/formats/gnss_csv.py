"""`gnss.csv`: satellite position fixes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lslam.formats.stamped_csv import read_stamped_csv, write_stamped_csv
from lslam.types.gnss import GnssStream

_NAMES = ("lat_deg", "lon_deg", "alt_m", "sigma_m")


def read_gnss_csv(path: Path) -> GnssStream:
    """Read fixes: `stamp_ns` (or seconds), `lat_deg`, `lon_deg`, `alt_m` (WGS84) and, if known, `sigma_m`.

    Without `sigma_m` the one-sigma error is NaN: unknown. Raises InputError naming file and line.
    """
    stamps, values = read_stamped_csv(
        path,
        [("lat_deg", "lat", "latitude"), ("lon_deg", "lon", "longitude"), ("alt_m", "alt", "altitude", "height")],
        [("sigma_m", "sigma", "pos_acc")],
    )
    return GnssStream(stamps, values[:, :3], values[:, 3])


def write_gnss_csv(path: Path, gnss: GnssStream) -> None:
    """Write `gnss` atomically; it reads back exactly."""
    write_stamped_csv(path, _NAMES, gnss.stamps_ns, np.hstack([gnss.lat_lon_alt, gnss.sigma[:, None]]))
