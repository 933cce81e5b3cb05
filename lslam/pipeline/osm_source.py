"""Where the buildings of a run come from: a file, or a server that is asked while odometry goes on."""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lslam.config import Config
from lslam.config.osm import OsmConfig
from lslam.errors import InputError, UsageError
from lslam.formats.osm_buildings import BuildingExtract, some_buildings_of
from lslam.formats.osm_files import OsmData, read_osm
from lslam.priors.osm_map import OsmMap
from lslam.types.sequence import Sequence

log = logging.getLogger("lslam")
Floats = NDArray[np.float64]

AUTO = "auto"
# m from the start to the nearest building: farther away is another town.
ANOTHER_TOWN = 10e3


class OsmSource(Protocol):
    """Gives the buildings of a run once its place on the Earth is known; `data` is what they were read from."""

    @property
    def data(self) -> OsmData:
        """Nodes, ways and relations."""

    def extract(self, origin: Floats) -> BuildingExtract:
        """The buildings in the local frame at `origin` (3,) lat, lon (deg), height (m)."""


class OsmFile:
    """The buildings of one file; another town's are refused before odometry begins."""

    def __init__(self, path: Path, origin: Floats) -> None:
        self._path, self.data = path, read_osm(path)
        away = OsmMap(self.extract(origin).buildings).distance(np.zeros(2))
        if away > ANOTHER_TOWN:
            raise InputError(
                f"{path} lies {away / 1000:.0f} km away from the start ({origin[0]:.5f},{origin[1]:.5f}): check --origin or "
                "fetch the extract of that place"
            )

    def extract(self, origin: Floats) -> BuildingExtract:
        """Its buildings in the local frame at `origin` (3,)."""
        return some_buildings_of(self.data, origin, self._path)


def start_of(sequence: Sequence, config: Config) -> Floats:
    """(3,) lat, lon (deg), height (m) of about where the run begins.

    Raises UsageError when nothing says it.
    """
    if config.osm.origin is not None:
        return np.array(config.osm.origin, np.float64)
    gnss = sequence.gnss if config.gnss.mode != "off" else None
    if gnss is None or not gnss.is_place.any():
        raise UsageError(
            "--osm has to know where the run begins: give --origin LAT,LON of the first scan, or --gnss or --georeference "
            "where the recording has satellite fixes"
        )
    return np.asarray(gnss.lat_lon_alt[gnss.is_place][0])


def open_osm(sequence: Sequence, config: Config) -> OsmSource | None:
    """What `osm.extract` names; None when it names nothing.

    Raises UsageError when nobody says where the run begins, InputError for a file that cannot be read or of another town.
    """
    if not config.osm.extract:
        return None
    return OsmFile(Path(config.osm.extract), start_of(sequence, config))


def extract_digest(config: OsmConfig) -> str:
    """Of the file's bytes, for the identity of a run; empty without one. Raises InputError when it cannot be read."""
    if config.extract in ("", AUTO):
        return config.extract
    try:
        return hashlib.sha256(Path(config.extract).read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{config.extract} cannot be read: {error.strerror or error}") from None
