"""Buildings along an unknown way: the next circle is requested in the background, before it is needed.

Del Tufo, section 3.1: a circle of `fetch_radius` about the estimate is asked for at once; when the estimate leaves the
circle of `renew_radius` about that place, the next one is. The caller never waits, so a slow server costs nothing, and a
dead one nothing but buildings.
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

from lslam.config.osm import OsmConfig
from lslam.errors import InputError, LslamError
from lslam.formats.atomic import atomic_write
from lslam.formats.osm_buildings import buildings_of
from lslam.formats.osm_files import from_overpass
from lslam.formats.overpass_reply import OverpassReply
from lslam.geometry.geodesy import from_local
from lslam.osm.bounds import Bounds, around
from lslam.untrusted import MISFIT

log = logging.getLogger("lslam")
NOTHING = OverpassReply(b"{}")

Fetch = Callable[[Bounds], Mapping[str, Any]]


@dataclass(frozen=True)
class _RequestedCircle:
    """A circle to be asked for: its place (2,) and radius, m."""

    centre: NDArray[np.float64]
    radius: float

    def is_at(self, place: NDArray[np.float64], radius: float) -> bool:
        return float(np.linalg.norm(place - self.centre)) <= radius


@dataclass(frozen=True)
class _Circle:
    """A finished request: the reply, of which buildings can be read; why it is none, else None."""

    wish: _RequestedCircle
    reply: OverpassReply
    problem: str | None = None


class OsmBuffer:
    """Replies about the surroundings of an estimate that moves; `replies` has them in the order in which they were asked for.

    Parameters
    ----------
    fetch : gives the Overpass reply for a box (`overpass.fetch_buildings`); called in a thread of the buffer's own
    origin : (3,) lat, lon (deg), height (m) of the local frame, x east and y north, in which everything here is
    config : the radii
    folder : where replies are kept, `000000.json` and so on; what lies there already is not asked for again, so that a run
        that was killed goes on with the same buildings. None keeps nothing

    Use it as a context manager, or `close` it.
    """

    def __init__(self, fetch: Fetch, origin: NDArray[Any], config: OsmConfig, folder: Path | None = None) -> None:
        self._fetch = fetch
        self._origin = np.asarray(origin, np.float64)
        self._config = config
        self._folder = folder
        self._wishes: queue.SimpleQueue[_RequestedCircle | None] = queue.SimpleQueue()
        self._done: queue.SimpleQueue[_Circle] = queue.SimpleQueue()
        self._open: list[_RequestedCircle] = []
        self._answered: list[_RequestedCircle] = []
        self.replies: list[OverpassReply] = []
        self.problems: list[str] = []
        self._thread: threading.Thread | None = None
        self._load()

    def ask(self, position: NDArray[Any], radius: float | None = None) -> None:
        """Ask for the circle about `position` (2,), m, unless what was asked for before reaches there; returns at once.

        Where a request failed, nothing is asked again before that circle is left. radius : m, other than `fetch_radius`
        """
        at = np.asarray(position, np.float64)[:2]
        self._collect()
        asked = [*self._answered, *self._open]
        wish = _RequestedCircle(at, self._config.fetch_radius if radius is None else radius)
        if any(
            w.radius >= wish.radius and w.is_at(at, self._config.renew_radius + w.radius - wish.radius) for w in asked
        ):
            return
        self._open.append(wish)
        if self._thread is None:
            # A thread that waits for a dead server must not keep the program from ending.
            self._thread = threading.Thread(
                target=copy_context().run, args=(self._work,), name="osm-buffer", daemon=True
            )
            self._thread.start()
        self._wishes.put(wish)

    def wait(self, seconds: float, requests: int | None = None) -> bool:
        """Wait for what is asked for, or for so many `requests` in all, at most `seconds`. True when nothing is open any more."""
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
        """Requests that were answered or refused so far."""
        return len(self._answered)

    def close(self) -> None:
        """Let the thread end; a request that is under way is not waited for."""
        self._collect()
        self._wishes.put(None)

    def __enter__(self) -> OsmBuffer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _work(self) -> None:
        while (wish := self._wishes.get()) is not None:
            self._done.put(self._circle(wish))

    def _circle(self, wish: _RequestedCircle) -> _Circle:
        try:
            fix = from_local(np.array([[*wish.centre, 0.0]]), self._origin)[:, :2]
            reply = OverpassReply.of(self._fetch(around(fix, wish.radius)))
            self._check(reply)
            return _Circle(wish, reply)
        except LslamError as error:
            return _Circle(wish, NOTHING, str(error))
        except Exception as error:
            # Whatever a server sends, the run goes on without it.
            log.debug("traceback", exc_info=error)
            return _Circle(wish, NOTHING, f"the reply cannot be used ({type(error).__name__}: {error})")

    def _check(self, reply: OverpassReply) -> None:
        """Raise what is wrong with a reply."""
        buildings_of(from_overpass(reply), self._origin, "the reply")

    def _keep(self, circle: _Circle, folder: Path) -> None:
        """What is used is kept, and nothing else: not what a server sends when nobody waits any more."""
        folder.mkdir(parents=True, exist_ok=True)
        asked = {"lslam_centre": circle.wish.centre.tolist(), "lslam_radius": circle.wish.radius}
        with atomic_write(folder / f"{len(self.replies):06d}.json") as stream:
            circle.reply.write(stream, asked)

    def _load(self) -> None:
        """Take what an earlier run kept."""
        for path in [] if self._folder is None else sorted(self._folder.glob("*.json")):
            try:
                reply = OverpassReply(path.read_bytes())
                facts = reply.facts()
                wish = _RequestedCircle(np.array(facts["lslam_centre"], np.float64), float(facts["lslam_radius"]))
                self._check(reply)
                self._use(_Circle(wish, reply))
            except (OSError, *MISFIT) as error:
                raise InputError(f"{path} is no reply kept by an earlier run ({error}): remove it") from None

    def _collect(self) -> None:
        while not self._done.empty():
            self._take(self._done.get())

    def _take(self, circle: _Circle) -> None:
        self._open = [wish for wish in self._open if wish is not circle.wish]
        if circle.problem is not None:
            self._answered.append(circle.wish)
            self.problems.append(circle.problem)
            log.warning("no buildings from OpenStreetMap here: %s", circle.problem)
            return
        if self._folder is not None:
            self._keep(circle, self._folder)
        self._use(circle)

    def _use(self, circle: _Circle) -> None:
        self._answered.append(circle.wish)
        self.replies.append(circle.reply)
