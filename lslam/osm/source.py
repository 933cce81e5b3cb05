"""Where the buildings of a run come from: a file, or a server that is asked while odometry goes on."""

from __future__ import annotations

import hashlib
import logging
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lslam.backend.georeferencing import require_crs
from lslam.config import Config
from lslam.config.osm import OsmConfig
from lslam.errors import InputError, UsageError, cause
from lslam.formats.osm_buildings import BuildingExtract, buildings_of, some_buildings_of
from lslam.formats.osm_files import OsmData, merged, read_osm
from lslam.formats.overpass_reply import OverpassReply
from lslam.geometry import se2
from lslam.geometry.geodesy import to_local
from lslam.osm.buffer import Fetch, OsmBuffer
from lslam.osm.overpass import fetch_buildings, reply_folder
from lslam.osm.walls import OsmMap
from lslam.types.gnss import GnssStream
from lslam.types.sequence import Sequence
from lslam.untrusted import MISFIT

log = logging.getLogger("lslam")
Floats = NDArray[np.float64]

AUTO = "auto"
# s that a run waits for its first buildings, and for the last ones when odometry is over.
FIRST_REPLY_S, LATER_REPLY_S = 60.0, 0.5
# m from the start to the nearest building: farther away is another town.
ANOTHER_TOWN = 10e3


class OsmSource(Protocol):
    """Gives the buildings of a run once its place on the Earth is known; `data` is what they were read from."""

    @property
    def data(self) -> OsmData:
        """Nodes, ways and relations."""

    def begin(self, folder: Path | None) -> None:
        """The run begins; `folder` keeps what it fetches."""

    def see(self, stamp_ns: int, T_world_lidar: Floats) -> None:
        """Odometry is here (4, 4) at this time; returns at once."""

    def extract(self, origin: Floats) -> BuildingExtract:
        """The buildings in the local frame at `origin` (3,) lat, lon (deg), height (m)."""


class OsmFile:
    """The buildings of one file, or of a folder of replies that a run has kept; another town's are refused at once."""

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
        """Nothing is to be kept."""

    def see(self, stamp_ns: int, T_world_lidar: Floats) -> None:
        """All there is, is there."""

    def extract(self, origin: Floats) -> BuildingExtract:
        """Its buildings in the local frame at `origin` (3,)."""
        return some_buildings_of(self.data, origin, self._path)


class OsmServer:
    """Buildings round the way of a run, asked for while odometry goes on.

    Where the run is on the Earth is said by its fixes, or by origin and heading; where nobody knows the heading, the
    circle about the origin grows with the distance from it.

    origin : (3,) lat, lon (deg), height (m) of about the first scan
    """

    def __init__(self, origin: Floats, gnss: GnssStream | None, config: OsmConfig, fetch: Fetch) -> None:
        self._origin, self._config, self._fetch = origin, config, fetch
        self._fixes = _places(gnss, origin) if gnss is not None and gnss.is_place.any() else None
        self._start: Floats | None = None
        self._buffer: OsmBuffer | None = None

    def begin(self, folder: Path | None) -> None:
        """Ask for the surroundings of the origin."""
        self._buffer = OsmBuffer(self._fetch, self._origin, self._config, folder)
        self._buffer.ask(np.zeros(2))

    def see(self, stamp_ns: int, T_world_lidar: Floats) -> None:
        """Ask for what comes next."""
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
        """What has come, in the local frame at `origin` (3,): for the first reply the run waits, for others hardly."""
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
        """All that has come so far."""
        return merged([] if self._buffer is None else self._buffer.replies)


def first_pose(config: OsmConfig) -> Floats:
    """(3,) of the first scan in the map frame, by origin and heading, which is 0 where unknown."""
    return np.array(
        [0.0, 0.0, 0.0 if config.heading_deg is None else se2.wrapped(np.radians(90.0 - config.heading_deg))]
    )


def _places(gnss: GnssStream, origin: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Stamps, ns, and places (F, 2), m, of the fixes that are some."""
    return gnss.stamps_ns[gnss.is_place], to_local(gnss.lat_lon_alt[gnss.is_place], origin)[:, :2]


def _kept_replies(folder: Path) -> OsmData:
    """Those a run has kept. Raises InputError when there are none, or for one that is damaged."""
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

    Raises UsageError when nobody says where the run begins or its result is wanted in coordinates that no map can be written
    in, InputError for a file that cannot be read or of another town.
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
    """Of the file's bytes, for the identity of a run; empty without one. Raises InputError when it cannot be read."""
    if config.extract in ("", AUTO):
        return config.extract
    path = Path(config.extract)
    try:
        files = sorted(path.glob("*.json")) if path.is_dir() else [path]
        return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    except OSError as error:
        raise InputError(f"{config.extract} cannot be read: {cause(error)}") from None
