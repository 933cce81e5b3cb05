"""Sources of a run's buildings: a file, or a server that is asked during odometry."""

from __future__ import annotations

import hashlib
import logging
import queue
import threading
from collections.abc import Callable, Mapping
from contextvars import copy_context
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lslam.backend.georeferencing import require_crs
from lslam.core.arrays import Floats, Longs
from lslam.core.config import Config
from lslam.core.config.backend import OsmConfig
from lslam.core.errors import InputError, LslamError, UsageError, input_errors
from lslam.core.geometry import se2
from lslam.core.geometry.geodesy import from_local, to_local
from lslam.core.types.gnss import GnssStream
from lslam.core.types.sequence import Sequence
from lslam.core.untrusted import MISFIT
from lslam.io.formats.atomic import atomic_write
from lslam.io.formats.osm_buildings import BuildingExtract, buildings_of, some_buildings_of
from lslam.io.formats.osm_data import OsmData
from lslam.io.formats.osm_files import read_osm
from lslam.osm.bounds import Bounds, around
from lslam.osm.overpass import OverpassReply, fetch_buildings, from_overpass, merge_replies, reply_folder
from lslam.osm.walls import OsmMap

log = logging.getLogger("lslam")

AUTO = "auto"
# s; longest wait for the first buildings, and for the last ones after odometry.
FIRST_REPLY_S, LATER_REPLY_S = 60.0, 0.5
# m; an extract without buildings within it of the start is that of another town.
ANOTHER_TOWN = 10e3
NOTHING = OverpassReply(b"{}")

Fetch = Callable[[Bounds], OverpassReply | Mapping[str, Any]]


class OsmSource(Protocol):
    """Source of the buildings of a run with a known origin; `data` has the elements that they are read from."""

    @property
    def data(self) -> OsmData:
        """Nodes, ways and relations."""

    def begin(self, folder: Path | None) -> None:
        """Start of a run; replies are written to `folder`."""

    def see(self, stamp_ns: int, T_world_lidar: Floats) -> None:
        """Use odometry's pose (4, 4) at a stamp, ns, where buildings are requested round it; returns at once."""

    def extract(self, origin: Floats) -> BuildingExtract:
        """The buildings in the local frame at `origin` (3,) lat, lon (deg), height (m)."""


@dataclass(frozen=True)
class _RequestedCircle:
    """A circle to be requested: its centre (2,) and radius, m, in the local frame."""

    centre: Floats
    radius: float

    def is_at(self, place: Floats, radius: float) -> bool:
        """Whether `place` (2,), m, is within `radius`, m, of the circle's centre."""
        return float(np.linalg.norm(place - self.centre)) <= radius


@dataclass(frozen=True)
class _Circle:
    """A finished request: its reply, and why there is no valid one, else None."""

    request: _RequestedCircle
    reply: OverpassReply
    problem: str | None = None


class OsmBuffer:
    """Replies about the surroundings of a moving estimate; `replies` has them in the order of the requests.

    Del Tufo, section 3.1: the buildings within `fetch_radius` of the estimate are requested; when the estimate is more than
    `renew_radius` from that place, the next ones are. The caller never waits: a slow or unreachable server does not delay a run.

    fetch : returns the Overpass reply for a box (`overpass.fetch_buildings`); called in a thread of the buffer
    origin : (3,) lat, lon (deg), height (m) of the local frame, x east and y north, of all positions here
    config : the radii
    folder : where replies are written, `000000.json` and so on. Replies that exist there are not requested again, so that a
        resumed run has the same buildings. None writes nothing

    Use it as a context manager, or `close` it.
    """

    def __init__(self, fetch: Fetch, origin: NDArray[Any], config: OsmConfig, folder: Path | None = None) -> None:
        self._fetch = fetch
        self._origin = np.asarray(origin, np.float64)
        self._config = config
        self._queue: queue.SimpleQueue[_RequestedCircle | None] = queue.SimpleQueue()
        self._done: queue.SimpleQueue[_Circle] = queue.SimpleQueue()
        self._open: list[_RequestedCircle] = []
        self._answered: list[_RequestedCircle] = []
        self.replies: list[OverpassReply] = []
        self.problems: list[str] = []
        self._thread: threading.Thread | None = None
        self._load(folder)

    def ask(self, position: NDArray[Any], radius: float | None = None) -> None:
        """Request the circle about `position` (2,), m, unless an earlier request covers it; returns at once.

        After a failed request nothing is requested again within its circle.
        radius : m, instead of `fetch_radius`
        """
        at = np.asarray(position, np.float64)[:2]
        self._collect()
        earlier = [*self._answered, *self._open]
        new = _RequestedCircle(at, self._config.fetch_radius if radius is None else radius)
        if any(
            c.radius >= new.radius and c.is_at(at, self._config.renew_radius + c.radius - new.radius) for c in earlier
        ):
            return
        self._open.append(new)
        if self._thread is None:
            # A daemon, so that a pending request does not delay the end of the program.
            self._thread = threading.Thread(
                target=copy_context().run, args=(self._work,), name="osm-buffer", daemon=True
            )
            self._thread.start()
        self._queue.put(new)

    def wait(self, seconds: float, requests: int | None = None) -> bool:
        """Wait, at most `seconds`, for all open requests or for `requests` finished ones in all; True when none is open."""
        while self._open and seconds > 0 and (requests is None or self.requests < requests):
            try:
                self._take(self._done.get(timeout=min(seconds, 0.05)))
            except queue.Empty:
                seconds -= 0.05
        return not self._open

    @property
    def is_waiting(self) -> bool:
        """True while a request is open."""
        self._collect()
        return bool(self._open)

    @property
    def requests(self) -> int:
        """Number of requests that succeeded or failed so far."""
        return len(self._answered)

    def close(self) -> None:
        """End the thread, without waiting for a request in progress."""
        self._collect()
        self._queue.put(None)

    def __enter__(self) -> OsmBuffer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _work(self) -> None:
        """Fetch the requested circles, until None is queued (in the thread)."""
        while (request := self._queue.get()) is not None:
            self._done.put(self._circle(request))

    def _circle(self, request: _RequestedCircle) -> _Circle:
        """Fetch the buildings of one requested circle (in the thread); a failure becomes the `problem` of the result."""
        try:
            fix = from_local(np.array([[*request.centre, 0.0]]), self._origin)[:, :2]
            reply = OverpassReply.of(self._fetch(around(fix, request.radius)))
            self._check(reply)
            return _Circle(request, reply)
        except LslamError as error:
            return _Circle(request, NOTHING, str(error))
        except Exception as error:
            # An invalid reply of any kind does not end the run.
            log.debug("traceback", exc_info=error)
            return _Circle(request, NOTHING, f"the reply cannot be used ({type(error).__name__}: {error})")

    def _check(self, reply: OverpassReply) -> None:
        """Raise an error where buildings cannot be read from a reply."""
        buildings_of(from_overpass(reply), self._origin, "the reply")

    def _keep(self, circle: _Circle, folder: Path) -> None:
        """Write the reply of a circle as the next file in `folder`."""
        folder.mkdir(parents=True, exist_ok=True)
        requested = {"lslam_centre": circle.request.centre.tolist(), "lslam_radius": circle.request.radius}
        with atomic_write(folder / f"{len(self.replies):06d}.json") as stream:
            circle.reply.write(stream, requested)

    def _load(self, folder: Path | None) -> None:
        """Set `folder` for later replies, and take those of an earlier run there; InputError for a damaged one."""
        self._folder = folder
        for path in [] if folder is None else sorted(folder.glob("*.json")):
            try:
                reply = OverpassReply(path.read_bytes())
                facts = reply.facts()
                request = _RequestedCircle(np.array(facts["lslam_centre"], np.float64), float(facts["lslam_radius"]))
                self._check(reply)
                self._use(_Circle(request, reply))
            except (OSError, *MISFIT) as error:
                raise InputError(f"{path} is no reply kept by an earlier run ({error}): remove it") from None

    def _collect(self) -> None:
        """Close all requests that are finished and keep their replies, as `_take`."""
        while not self._done.empty():
            self._take(self._done.get())

    def _take(self, circle: _Circle) -> None:
        """Close the request of `circle`; keep its reply, on disk too, or log its problem."""
        self._open = [request for request in self._open if request is not circle.request]
        if circle.problem is not None:
            self._answered.append(circle.request)
            self.problems.append(circle.problem)
            log.warning("no buildings from OpenStreetMap here: %s", circle.problem)
            return
        if self._folder is not None:
            self._keep(circle, self._folder)
        self._use(circle)

    def _use(self, circle: _Circle) -> None:
        """Add the reply of a circle to `replies`."""
        self._answered.append(circle.request)
        self.replies.append(circle.reply)


class OsmServer(OsmBuffer):
    """Buildings around the trajectory of a run, requested during odometry.

    The position on the Earth is that of the fixes, or follows from origin and heading. Without a heading the circle about the
    origin grows with the distance from it.

    origin : (3,) lat, lon (deg), height (m), approximately of the first scan
    """

    def __init__(self, origin: Floats, gnss: GnssStream | None, config: OsmConfig, fetch: Fetch) -> None:
        super().__init__(fetch, origin, config)
        # Stamps (F,), ns, and positions (F, 2), m, of the valid fixes.
        self._fixes: tuple[Longs, Floats] | None = None
        if gnss is not None and gnss.is_place.any():
            places = to_local(gnss.lat_lon_alt[gnss.is_place], origin)[:, :2]
            self._fixes = gnss.stamps_ns[gnss.is_place], places
        self._start: Floats | None = None

    def begin(self, folder: Path | None) -> None:
        """Request the buildings around the origin."""
        self._load(folder)
        self.ask(np.zeros(2))

    def see(self, stamp_ns: int, T_world_lidar: Floats) -> None:
        """Request the buildings around the sensor, unless an earlier request covers them.

        The place is the fix at `stamp_ns`, else the pose T_world_lidar by the configured heading. With neither, a circle about
        the origin is requested that doubles with the distance from it.
        """
        at = se2.of_se3(T_world_lidar)
        self._start = at if self._start is None else self._start
        step = se2.relative(self._start, at)
        if self._fixes is not None:
            stamps, places = self._fixes
            self.ask(np.array([np.interp(stamp_ns, stamps, places[:, axis]) for axis in (0, 1)]))
        elif self._config.heading_deg is not None:
            self.ask(se2.compose(first_pose(self._config), step)[:2])
        else:
            away = float(np.hypot(step[0], step[1]))
            doubled = np.ceil(np.log2(max(away / self._config.renew_radius, 1.0)))
            self.ask(np.zeros(2), self._config.fetch_radius * 2.0**doubled)

    def extract(self, origin: Floats) -> BuildingExtract:
        """The buildings received so far, in the frame at `origin` (3,). Raises InputError without a reply.

        Waits for the first reply, and for a short time for the others.
        """
        self.wait(FIRST_REPLY_S, requests=1)
        self.wait(LATER_REPLY_S)
        self.close()
        if not self.replies:
            why = self.problems[0] if self.problems else "no reply came in time"
            raise InputError(f"no buildings from {self._config.server}: {why}")
        if self.is_waiting:
            log.warning("OSM: %s has not sent all buildings along the way in time", self._config.server)
        return buildings_of(self.data, origin, self._config.server)

    @property
    def data(self) -> OsmData:
        """The elements of all replies so far."""
        return merge_replies(self.replies)


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
        """The buildings of the file in the local frame at `origin` (3,)."""
        return some_buildings_of(self.data, origin, self._path)


def first_pose(config: OsmConfig) -> Floats:
    """Planar pose (3,) of the first scan in the map frame, by origin and heading; yaw 0 when the heading is unknown."""
    return np.array([0.0, 0.0, 0.0 if config.heading_deg is None else se2.wrap(np.radians(90.0 - config.heading_deg))])


def _kept_replies(folder: Path) -> OsmData:
    """The elements of the replies in `folder`. Raises InputError when there are none, or for one that is damaged."""
    files = sorted(folder.glob("*.json"))
    if not files:
        raise InputError(
            f"{folder} holds no replies of an Overpass server (000000.json, ...): name a file, or that folder"
        )
    try:
        return merge_replies(OverpassReply(file.read_bytes()) for file in files)
    except (OSError, *MISFIT) as error:
        raise InputError(f"{folder} holds a reply that cannot be read ({error})") from None


def start_of(sequence: Sequence, config: Config) -> Floats:
    """Approximate origin (3,), lat, lon (deg), height (m), configured or the first fix's; UsageError without either."""
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
    """Digest of the bytes of the extract, a file or a folder of replies, for the identity of a run.

    Without an extract, or with `auto`, that setting itself. Raises InputError for an unreadable file.
    """
    if config.extract in ("", AUTO):
        return config.extract
    path = Path(config.extract)
    with input_errors(config.extract):
        files = sorted(path.glob("*.json")) if path.is_dir() else [path]
        return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
