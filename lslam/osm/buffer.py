"""Buildings along a trajectory that is being estimated: the next circle is requested in the background, before it is needed.

Del Tufo, section 3.1: the buildings within `fetch_radius` of the estimate are requested; when the estimate is more than
`renew_radius` from that place, the next ones are. The caller never waits: a slow or unreachable server does not delay a run.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Mapping
from contextvars import copy_context
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.config.backend import OsmConfig
from lslam.core.errors import InputError, LslamError
from lslam.core.geometry.geodesy import from_local
from lslam.core.types.arrays import Floats
from lslam.core.untrusted import MISFIT
from lslam.io.formats.atomic import atomic_write
from lslam.io.formats.osm_buildings import buildings_of
from lslam.osm.bounds import Bounds, around
from lslam.osm.overpass import OverpassReply, from_overpass

log = logging.getLogger("lslam")
NOTHING = OverpassReply(b"{}")

Fetch = Callable[[Bounds], Mapping[str, Any]]


@dataclass(frozen=True)
class _RequestedCircle:
    """A circle to be requested: its centre (2,) and radius, m, in the local frame."""

    centre: Floats
    radius: float

    def is_at(self, place: Floats, radius: float) -> bool:
        return float(np.linalg.norm(place - self.centre)) <= radius


@dataclass(frozen=True)
class _Circle:
    """A finished request: its reply, and why there is no valid one, else None."""

    request: _RequestedCircle
    reply: OverpassReply
    problem: str | None = None


class OsmBuffer:
    """Replies about the surroundings of a moving estimate; `replies` has them in the order of the requests.

    Parameters
    ----------
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
        self._folder = folder
        self._queue: queue.SimpleQueue[_RequestedCircle | None] = queue.SimpleQueue()
        self._done: queue.SimpleQueue[_Circle] = queue.SimpleQueue()
        self._open: list[_RequestedCircle] = []
        self._answered: list[_RequestedCircle] = []
        self.replies: list[OverpassReply] = []
        self.problems: list[str] = []
        self._thread: threading.Thread | None = None
        self._load()

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
        while (request := self._queue.get()) is not None:
            self._done.put(self._circle(request))

    def _circle(self, request: _RequestedCircle) -> _Circle:
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
        """Raise the errors of an invalid reply."""
        buildings_of(from_overpass(reply), self._origin, "the reply")

    def _keep(self, circle: _Circle, folder: Path) -> None:
        """Write a reply that is used; replies after the last wait are not written."""
        folder.mkdir(parents=True, exist_ok=True)
        requested = {"lslam_centre": circle.request.centre.tolist(), "lslam_radius": circle.request.radius}
        with atomic_write(folder / f"{len(self.replies):06d}.json") as stream:
            circle.reply.write(stream, requested)

    def _load(self) -> None:
        """Read the replies that an earlier run wrote."""
        for path in [] if self._folder is None else sorted(self._folder.glob("*.json")):
            try:
                reply = OverpassReply(path.read_bytes())
                facts = reply.facts()
                request = _RequestedCircle(np.array(facts["lslam_centre"], np.float64), float(facts["lslam_radius"]))
                self._check(reply)
                self._use(_Circle(request, reply))
            except (OSError, *MISFIT) as error:
                raise InputError(f"{path} is no reply kept by an earlier run ({error}): remove it") from None

    def _collect(self) -> None:
        while not self._done.empty():
            self._take(self._done.get())

    def _take(self, circle: _Circle) -> None:
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
        self._answered.append(circle.request)
        self.replies.append(circle.reply)
