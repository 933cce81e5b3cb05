"""Sources of a run's buildings: a file, or a server that is asked during odometry."""

from __future__ import annotations

import hashlib
import logging
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np

from lslam.backend.georeferencing import require_crs
from lslam.core.config import Config
from lslam.core.config.backend import OsmConfig
from lslam.core.errors import InputError, UsageError, cause
from lslam.core.geometry import se2
from lslam.core.geometry.geodesy import to_local
from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.gnss import GnssStream
from lslam.core.types.sequence import Sequence
from lslam.core.untrusted import MISFIT
from lslam.io.formats.osm_buildings import BuildingExtract, buildings_of, some_buildings_of
from lslam.io.formats.osm_data import OsmData
from lslam.io.formats.osm_files import read_osm
from lslam.osm.buffer import Fetch, OsmBuffer
from lslam.osm.overpass import OverpassReply, fetch_buildings, merged, reply_folder
from lslam.osm.walls import OsmMap

log = logging.getLogger("lslam")

AUTO = "auto"
# s; longest wait for the first buildings, and for the last ones after odometry.
FIRST_REPLY_S, LATER_REPLY_S = 60.0, 0.5
# m; an extract without buildings within it of the start is that of another town.
ANOTHER_TOWN = 10e3


class OsmSource(Protocol):
    """Source of the buildings of a run with a known origin; `data` has the elements that they are read from."""

    @property
    def data(self) -> OsmData:
        """Nodes, ways and relations."""

    def begin(self, folder: Path | None) -> None:
        """Start of a run; replies are written to `folder`."""

    def see(self, stamp_ns: int, T_world_lidar: Floats) -> None:
        """Take the estimate (4, 4) of odometry at a stamp, ns; returns at once."""

    def extract(self, origin: Floats) -> BuildingExtract:
        """The buildings in the local frame at `origin` (3,) lat, lon (deg), height (m)."""


class OsmFile:
    """The buildings of a file, or of a folder of an earlier run's replies. Raises InputError for those of another town."""

    def __init__(self, path: Path, origin: Floats) -> None:
        self._path = path
        self.data = _kept_replies(path) if path.is_dir() else read_osm(path)
        away = OsmMap(self.extract(origin).buildings).distance(np.zeros(2))
        if away > ANOTHER_TOWN:
            raise InputError(
                f"{path} lies {away / 1000:.0f} km away from the start ({origin[0]:.5f},{origin[1]:.5f}): check --origin or "
                "fetch the extract of that place"
            )

    def begin(self, folder: Path | None) -> None:
        """Nothing is fetched or written."""

    def see(self, stamp_ns: int, T_world_lidar: Floats) -> None:
        """Nothing is fetched: all buildings are read."""

    def extract(self, origin: Floats) -> BuildingExtract:
        """Its buildings in the local frame at `origin` (3,)."""
        return some_buildings_of(self.data, origin, self._path)


class OsmServer:
    """Buildings around the trajectory of a run, requested during odometry.

    The position on the Earth is that of the fixes, or follows from origin and heading. Without a heading the circle about the
    origin grows with the distance from it.

    origin : (3,) lat, lon (deg), height (m), approximately of the first scan
    """

    def __init__(self, origin: Floats, gnss: GnssStream | None, config: OsmConfig, fetch: Fetch) -> None:
        self._origin, self._config, self._fetch = origin, config, fetch
        self._fixes = _places(gnss, origin) if gnss is not None and gnss.is_place.any() else None
        self._start: Floats | None = None
        self._buffer: OsmBuffer | None = None

    def begin(self, folder: Path | None) -> None:
        """Request the buildings around the origin."""
        self._buffer = OsmBuffer(self._fetch, self._origin, self._config, folder)
        self._buffer.ask(np.zeros(2))

    def see(self, stamp_ns: int, T_world_lidar: Floats) -> None:
        """Request the buildings around the estimate, when they are not requested yet."""
        assert self._buffer is not None
        at = se2.of_se3(T_world_lidar)
        self._start = at if self._start is None else self._start
        step = se2.relative(self._start, at)
        if self._fixes is not None:
            stamps, places = self._fixes
            self._buffer.ask(np.array([np.interp(stamp_ns, stamps, places[:, axis]) for axis in (0, 1)]))
        elif self._config.heading_deg is not None:
            self._buffer.ask(se2.compose(first_pose(self._config), step)[:2])
        else:
            away = float(np.hypot(step[0], step[1]))
            doubled = np.ceil(np.log2(max(away / self._config.renew_radius, 1.0)))
            self._buffer.ask(np.zeros(2), self._config.fetch_radius * 2.0**doubled)

    def extract(self, origin: Floats) -> BuildingExtract:
        """The buildings received, in the local frame at `origin` (3,), after a wait for the first reply and a short one more."""
        assert self._buffer is not None
        self._buffer.wait(FIRST_REPLY_S, requests=1)
        self._buffer.wait(LATER_REPLY_S)
        self._buffer.close()
        if not self._buffer.replies:
            why = self._buffer.problems[0] if self._buffer.problems else "no reply came in time"
            raise InputError(f"no buildings from {self._config.server}: {why}")
        if self._buffer.is_waiting:
            log.warning("OSM: %s has not sent all buildings along the way in time", self._config.server)
        return buildings_of(self.data, origin, self._config.server)

    @property
    def data(self) -> OsmData:
        """The elements of all replies so far."""
        return merged([] if self._buffer is None else self._buffer.replies)


def first_pose(config: OsmConfig) -> Floats:
    """Planar pose (3,) of the first scan in the map frame, by origin and heading; yaw 0 when the heading is unknown."""
    return np.array(
        [0.0, 0.0, 0.0 if config.heading_deg is None else se2.wrapped(np.radians(90.0 - config.heading_deg))]
    )


def _places(gnss: GnssStream, origin: Floats) -> tuple[Longs, Floats]:
    """Stamps (F,), ns, and positions (F, 2), m, of the valid fixes."""
    return gnss.stamps_ns[gnss.is_place], to_local(gnss.lat_lon_alt[gnss.is_place], origin)[:, :2]


def _kept_replies(folder: Path) -> OsmData:
    """The elements of the replies in `folder`. Raises InputError when there are none, or for one that is damaged."""
    files = sorted(folder.glob("*.json"))
    if not files:
        raise InputError(
            f"{folder} holds no replies of an Overpass server (000000.json, ...): name a file, or that folder"
        )
    try:
        return merged(OverpassReply(file.read_bytes()) for file in files)
    except (OSError, *MISFIT) as error:
        raise InputError(f"{folder} holds a reply that cannot be read ({error})") from None


def start_of(sequence: Sequence, config: Config) -> Floats:
    """Approximate origin (3,) of the run, lat, lon (deg), height (m): as configured, or its first fix.

    Raises UsageError when there is neither.
    """
    if config.osm.origin is not None:
        return np.array(config.osm.origin, np.float64)
    gnss = sequence.gnss if config.gnss.mode != "off" else None
    if gnss is None or not gnss.is_place.any():
        raise UsageError(
            "--osm needs the place of the start: give --origin LAT,LON of the first scan, or --gnss or --georeference "
            "for a recording with satellite fixes"
        )
    return np.asarray(gnss.lat_lon_alt[gnss.is_place][0])


def open_osm(sequence: Sequence, config: Config) -> OsmSource | None:
    """The source that `osm.extract` names; None without one.

    Raises UsageError when the start has no place on the Earth, or the configured CRS cannot be written; InputError for a file
    that cannot be read or is of another town.
    """
    if not config.osm.extract:
        return None
    origin = start_of(sequence, config)
    require_crs(origin, config.gnss)
    if config.osm.extract == AUTO:
        fetch = partial(fetch_buildings, config=config.osm, folder=reply_folder())
        return OsmServer(origin, sequence.gnss if config.gnss.mode != "off" else None, config.osm, fetch)
    return OsmFile(Path(config.osm.extract), origin)


def extract_digest(config: OsmConfig) -> str:
    """Digest of the file's bytes, for the identity of a run; empty without a file. Raises InputError when it is unreadable."""
    if config.extract in ("", AUTO):
        return config.extract
    path = Path(config.extract)
    try:
        files = sorted(path.glob("*.json")) if path.is_dir() else [path]
        return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    except OSError as error:
        raise InputError(f"{config.extract} cannot be read: {cause(error)}") from None
