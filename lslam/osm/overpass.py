"""Buildings from an Overpass server: one request at a time, none for cached places, repeated when the server is busy.

Replies are cached as the server sent them; a box inside a cached one needs no network.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import logging
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from contextvars import copy_context
from pathlib import Path
from typing import IO, Any

import numpy as np

from lslam.core import __version__
from lslam.core.config.backend import OsmConfig
from lslam.core.errors import InputError, OutputError, UsageError
from lslam.core.kernels.cache import cache_folder
from lslam.core.machine import one_at_a_time
from lslam.core.untrusted import JsonItems, whole_number
from lslam.io.formats.atomic import atomic_write
from lslam.io.formats.osm_data import OsmData
from lslam.io.formats.osm_files import ELEMENTS, GaveUpError, add_elements, check_reply
from lslam.osm.bounds import Bounds


class OverpassReply:
    """The reply of a server as its text, of which nothing is checked: JSON in UTF-8, made of UTF-8, UTF-16 or UTF-32."""

    def __init__(self, text: bytes) -> None:
        encoding = json.detect_encoding(text[:4])
        self.text = text if encoding == "utf-8" else text.decode(encoding, "surrogatepass").encode("utf-8", "replace")

    @classmethod
    def of(cls, tree: OverpassReply | Mapping[str, Any]) -> OverpassReply:
        """A reply object from a parsed reply; a reply object is returned unchanged."""
        return tree if isinstance(tree, cls) else cls(json.dumps(tree, ensure_ascii=False).encode("utf-8", "replace"))

    def items_of(self) -> JsonItems:
        """Iterator over its elements, one at a time; iterating raises ValueError as `JsonItems`."""
        return JsonItems(io.BytesIO(self.text), ELEMENTS)

    def write(self, stream: IO[bytes], facts: Mapping[str, Any]) -> None:
        """Write the text of a checked reply, with `facts` inserted at the beginning of its object."""
        stream.write(json.dumps(facts).encode().removesuffix(b"}") + b", ")
        stream.write(memoryview(self.text)[self.text.index(b"{") + 1 :])

    def facts(self) -> dict[str, Any]:
        """Everything in the reply but its elements."""
        found = self.items_of()
        for _ in found:
            pass
        return found.rest

    def __repr__(self) -> str:
        return f"OverpassReply({self.text[:60]!r}..., {len(self.text)} bytes)"


def from_overpass(reply: Any) -> OsmData:
    """An Overpass reply (`[out:json]`), an `OverpassReply` or parsed already. Raises as `merge_replies`."""
    return merge_replies([reply])


def merge_replies(replies: Iterable[Any]) -> OsmData:
    """One extract of many Overpass replies, without duplicates.

    Raises ValueError for an invalid reply; GaveUpError, a subclass, for one in which the server reports that it gave up.
    """
    data = OsmData()
    for reply in replies:
        items = OverpassReply.of(reply).items_of()
        add_elements(data, items)
        check_reply(items)
    data.number_outlines()
    return data


log = logging.getLogger("lslam")

USER_AGENT = f"lslam/{__version__} (batch LiDAR SLAM; buildings around a recorded trajectory)"
CONNECT_TIMEOUT_S = 10.0  # s; longest wait for a connection
BACKOFF_S = 5.0  # s; wait after the first refusal, doubled after each further one
LONGEST_REPLY = 48 * 1024 * 1024  # bytes; its text is kept, and read element by element
LONGEST_WAIT = 120.0  # s; a server that asks for a longer wait is not asked again
FAR_OUT = 1000.0  # m; a long building reaches that far out of a box
_BUSY = (429, 502, 503, 504)
_one_thread_at_a_time = threading.Lock()


class _TryAgainError(Exception):
    """The server is busy, or the connection broke; `wait` : s, as the server requests, None without a request."""

    def __init__(self, why: str, wait: float | None = None) -> None:
        super().__init__(why)
        self.wait = wait


def query(bounds: Bounds, timeout: float) -> str:
    """Overpass QL for all building outlines that touch `bounds`."""
    box = str(bounds)
    return (
        f'[out:json][timeout:{round(timeout)}];(way["building"]({box});'
        f'relation["building"]["type"="multipolygon"]({box}););out body;>;out skel qt;'
    )


def reply_folder() -> Path:
    """Folder of the cached replies, or a new temporary folder when the user has no cache."""
    return cache_folder("osm") or Path(tempfile.mkdtemp(prefix="lslam-osm-"))


def fetch_buildings(
    bounds: Bounds, config: OsmConfig, folder: Path, sleep: Callable[[float], None] = time.sleep
) -> OverpassReply:
    """The Overpass reply for `bounds`: from `folder` when a reply for it or a larger box is there, else from `config.server`.

    It is checked (by `from_overpass`) and written to `folder` when it is complete. `sleep` waits between attempts.

    Raises InputError when the server is unreachable or busy at all attempts, when the reply is a web page, incomplete, too
    long or about another place, and when `config.cache` is `only` and there is no reply in `folder`.
    """
    kept = kept_reply(bounds, folder) if config.cache != "refresh" else None
    if kept is not None:
        return kept
    if config.cache == "only":
        raise InputError(
            f"no reply for {bounds} is in {folder}: ask a server for it once, osm.cache = use, without --offline"
        )
    try:
        reply = _ask_patiently(bounds, config, folder, sleep)
    except InputError as error:
        # Buildings change slowly: an old reply is better than none.
        kept = kept_reply(bounds, folder)
        if kept is None:
            raise
        log.warning("%s; using what was fetched before", error)
        return kept
    with contextlib.suppress(OutputError, OSError):
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(folder / _file_name(bounds)) as stream:
            stream.write(reply.text)
    return reply


def kept_reply(bounds: Bounds, folder: Path) -> OverpassReply | None:
    """The cached reply for `bounds`, or for the smallest cached box around it; None without a valid one."""
    exact = folder / _file_name(bounds)
    larger = [(box.area_km2, path) for path in folder.glob("*.json") if (box := _bounds_of(path)) and box.holds(bounds)]
    for path in [exact, *(path for _, path in sorted(larger))]:
        try:
            return _check_place(OverpassReply(path.read_bytes()), bounds, is_own=path == exact)
        except (OSError, ValueError):
            continue
    return None


def _file_name(bounds: Bounds) -> str:
    """File name with the box, which `Bounds.holds` compares, and a digest of the query, which may change with a version."""
    return f"{bounds}-{hashlib.sha256(query(bounds, 180).encode()).hexdigest()[:16]}.json"


def _bounds_of(path: Path) -> Bounds | None:
    """Box in the file name of a cached reply; None for other files."""
    with contextlib.suppress(ValueError, TypeError, UsageError):
        bounds = Bounds(*(float(v) for v in path.name.rsplit("-", 1)[0].split(",")))
        return bounds if _file_name(bounds) == path.name else None
    return None


def _ask_patiently(bounds: Bounds, config: OsmConfig, folder: Path, sleep: Callable[[float], None]) -> OverpassReply:
    """Request the buildings in `bounds`, `config.attempts` times at most with growing pauses (s); then InputError."""
    wait = BACKOFF_S
    # All threads and processes of this user together send one request at a time.
    with _one_thread_at_a_time, one_at_a_time(folder / "request.lock", "asks the map server"):
        for attempt in range(1, config.attempts + 1):
            try:
                return _ask(bounds, config)
            except _TryAgainError as error:
                wanted = wait if error.wait is None else error.wait
                if attempt == config.attempts or wanted > LONGEST_WAIT:
                    times = f"after {attempt} attempts" if attempt > 1 else "and asks for a long break"
                    raise InputError(
                        f"{config.server} gave no buildings {times}: {error}; try later, or another server (osm.server)"
                    ) from None
                log.info("%s: %s, again in %.3g s", config.server, error, wanted)
                sleep(wanted)
                wait *= 2
    raise AssertionError("the last attempt returns or raises")


def _ask(bounds: Bounds, config: OsmConfig) -> OverpassReply:
    """Send one request. Raises _TryAgainError when another attempt may succeed, InputError when it cannot.

    It runs in a thread of its own, because looking up a name and receiving headers have no timeout: all of it together takes
    `config.timeout` at most.
    """
    reply: Future[bytes] = Future()
    is_late = threading.Event()

    def exchange() -> None:
        try:
            reply.set_result(_exchange(bounds, config, is_late))
        except BaseException as error:
            reply.set_exception(error)

    threading.Thread(target=copy_context().run, args=(exchange,), name="overpass", daemon=True).start()
    try:
        body = reply.result(config.timeout)
    except TimeoutError:
        raise InputError(_too_late(config.server, config.timeout)) from None
    finally:
        is_late.set()
    return _parse(body, bounds, config.server)


def _exchange(bounds: Bounds, config: OsmConfig, is_late: threading.Event) -> bytes:
    """The body of the server's reply. Raises _TryAgainError for a broken connection or a busy server, else InputError."""
    import requests

    server = config.server
    try:
        with requests.post(
            server,
            data={"data": query(bounds, config.timeout)},
            headers={"User-Agent": USER_AGENT, "Accept": "application/json"},
            timeout=(CONNECT_TIMEOUT_S, config.timeout),
            allow_redirects=False,
            stream=True,
        ) as reply:
            _check_status(reply, server)
            return _read(reply, server, config.timeout, is_late)
    except requests.exceptions.Timeout as error:
        is_connecting = isinstance(error, requests.exceptions.ConnectTimeout)
        raise InputError(_too_late(server, CONNECT_TIMEOUT_S if is_connecting else config.timeout)) from None
    except requests.exceptions.ConnectionError as error:
        reason = getattr(error.args[0] if error.args else None, "reason", None)
        if type(reason).__name__ in ("NewConnectionError", "NameResolutionError"):
            raise InputError(f"{server} cannot be reached: check the network, or name another osm.server") from None
        raise _TryAgainError("the connection broke") from None
    except requests.exceptions.RequestException as error:
        raise InputError(f"{server} cannot be asked: {error}") from None


def _check_status(reply: Any, server: str) -> None:
    """Raise _TryAgainError for a busy server (with its `Retry-After`, s), InputError for any other status than 200."""
    status = reply.status_code
    if status in _BUSY:
        said = reply.headers.get("Retry-After", "")
        raise _TryAgainError(
            f"it is busy (HTTP {status})", None if (wait := whole_number(said)) is None else float(wait)
        )
    if 300 <= status < 400:
        to = reply.headers.get("Location", "nowhere")
        raise InputError(f"{server} redirects to {to[:120]}: set osm.server to an Overpass server's own address")
    if status != 200:
        raise InputError(f"{server} refused the request (HTTP {status}): check osm.server")


def _read(reply: Any, server: str, timeout: float, is_late: threading.Event) -> bytes:
    """Body in parts, whose length and time are checked (InputError); raises _TryAgainError for a broken connection."""
    import urllib3

    body = io.BytesIO()  # `getvalue` makes no copy
    try:
        while part := reply.raw.read1(65536, decode_content=True):
            body.write(part)
            if body.tell() > LONGEST_REPLY:
                raise InputError(f"the reply grows beyond {LONGEST_REPLY >> 20} MB: ask for a smaller place")
            if is_late.is_set():
                raise InputError(_too_late(server, timeout))
    except urllib3.exceptions.ReadTimeoutError:
        raise InputError(_too_late(server, timeout)) from None
    except urllib3.exceptions.HTTPError:
        raise _TryAgainError("the connection broke") from None
    return body.getvalue()


def _too_late(server: str, limit: float) -> str:
    # No second attempt: a server that is merely busy answers so.
    """Message that the server did not answer in time."""
    return f"{server} did not answer within {limit:g} s: try later, or name another osm.server"


def _parse(body: bytes, bounds: Bounds, server: str) -> OverpassReply:
    """The reply in `body`. Raises _TryAgainError where it is cut short or the server gave up, InputError where it is invalid."""
    if body[:64].lstrip()[:1] == b"<":
        raise InputError(f"{server} answered with a web page, not with data: check osm.server")
    try:
        return _check_place(OverpassReply(body), bounds)
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise _TryAgainError("the reply was cut short") from None
    except GaveUpError as error:
        raise _TryAgainError(f"it gave up ({error.remark[:120]})") from None
    except ValueError as error:
        raise InputError(f"the reply of {server} cannot be used, {error}: check osm.server") from None


def _check_place(reply: OverpassReply, bounds: Bounds, is_own: bool = True) -> OverpassReply:
    """Check a reply and return it. Raises ValueError if it is invalid, or of another place.

    is_own : whether the request was for exactly `bounds`; then most of the nodes must lie near them
    """
    data = from_overpass(reply)
    places = np.array([*data.nodes.values()]).reshape(-1, 2)
    if is_own and bounds.share_inside(places, FAR_OUT) < 0.5:
        lat, lon = np.median(places, axis=0)
        raise ValueError(f"most of it lies elsewhere, about {lat:.4f},{lon:.4f}")
    return reply
