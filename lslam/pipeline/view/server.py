"""Server of `lslam view`: on 127.0.0.1 alone, for whoever knows the token in its address, and for no page but its own."""

from __future__ import annotations

import json
import logging
import secrets
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from lslam.core.errors import LslamError, UsageError, cause
from lslam.core.untrusted import parse_json
from lslam.reports.evaluations import strict

log = logging.getLogger("lslam")

HOST = "127.0.0.1"
MOST_BODY = 1 << 20  # bytes of a request
IDLE_S = 30.0
# What a browser may show of a run folder by itself; all else is downloaded.
KINDS = {
    ".json": "application/json",
    ".csv": "text/csv",
    ".txt": "text/plain",
    ".toml": "text/plain",
    ".png": "image/png",
}
ALWAYS = {
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class RefusedError(Exception):
    """A request that the server rejects, with an HTTP status."""

    def __init__(self, status: HTTPStatus, message: str = "") -> None:
        super().__init__(message or status.phrase)
        self.status = status


@dataclass(frozen=True)
class Answer:
    """Content with its kind, or a file with it; further headers."""

    kind: str
    body: bytes = b""
    file: Path | None = None
    headers: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Site:
    """What a run answers below its address.

    page : gives the first page; gets, posts : functions by name, with the query's words, or a JSON document
    node : gives the bytes of a tile by its name, None where there is none
    """

    folder: Path
    page: Callable[[], Answer]
    gets: Mapping[str, Callable[[dict[str, str]], Any]]
    posts: Mapping[str, Callable[[Any], Any]]
    node: Callable[[str], bytes | None]


class RunServer(ThreadingHTTPServer):
    """HTTP server of the sites of runs: `/TOKEN/` for the first, `/TOKEN/1/`, ... for others.

    port : 0 for any that is free. Raises UsageError when it is in use.
    """

    daemon_threads = True

    def __init__(self, port: int = 0) -> None:
        try:
            super().__init__((HOST, port), _Handler)
        except (OSError, OverflowError) as error:
            raise UsageError(
                f"--port {port} cannot be used: {cause(error)}; leave it out for any that is free"
            ) from None
        self.token = secrets.token_urlsafe(24)
        self.sites: list[Site] = []
        self.names = tuple(f"{name}:{self.server_port}" for name in (HOST, "localhost"))

    @property
    def url(self) -> str:
        """Address of the first run's page."""
        return f"http://{self.names[0]}/{self.token}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore errors of connections: a browser that closes one while it is answered is no fault."""
        log.debug("view: a connection ended", exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    """Handler of one connection."""

    server: RunServer
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "lslam", ""
    timeout = IDLE_S

    def do_GET(self) -> None:
        """Answer with a page, a file, a tile or what the API knows."""
        self._answer(self._get)

    def do_HEAD(self) -> None:
        """Answer as GET, without the content."""
        self._answer(self._get)

    def do_POST(self) -> None:
        """Have the API do something."""
        self._answer(self._post)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer a rejected request, such as an unsupported method, with a status and a message in JSON."""
        is_method = code == HTTPStatus.NOT_IMPLEMENTED
        status = HTTPStatus.METHOD_NOT_ALLOWED if is_method else HTTPStatus(code)
        self.close_connection = True
        answer = _json({"error": status.phrase if is_method or message is None else message})
        self._send(status, replace(answer, headers=(("Allow", "GET, HEAD, POST"),) if is_method else ()))

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Write requests to the debug log of lslam alone, since addresses contain the token."""
        log.debug("view: %s", (format % args).replace(self.server.token, "TOKEN"))

    def _answer(self, method: Callable[[], Answer]) -> None:
        """Send the answer of `method`, or an error status: refused, LslamError (422), any other exception (500)."""
        status, answer = HTTPStatus.OK, Answer("application/json", b"{}")
        try:
            self._require_own()
            answer = method()
        except RefusedError as refused:
            self.close_connection = True  # its body may not be read
            status, answer = refused.status, _json({"error": str(refused)})
        except LslamError as error:
            status, answer = HTTPStatus.UNPROCESSABLE_ENTITY, _json({"error": str(error)})
        except Exception as error:
            log.debug("view: %s", self.path.replace(self.server.token, "TOKEN"), exc_info=True)
            message = f"lslam made a mistake ({type(error).__name__}: {error})"
            status, answer = HTTPStatus.INTERNAL_SERVER_ERROR, _json({"error": message})
        self._send(status, answer)

    def _send(self, status: HTTPStatus, answer: Answer) -> None:
        """Send status, headers and body or file of the answer; no body for HEAD."""
        stream = answer.file.open("rb") if answer.file is not None else None
        try:
            size = len(answer.body) if stream is None else stream.seek(0, 2)
            self.send_response(status)
            headers = [("Content-Type", answer.kind), ("Content-Length", str(size)), *ALWAYS.items(), *answer.headers]
            for name, value in [*headers, *([("Connection", "close")] if self.close_connection else [])]:
                self.send_header(name, value)
            self.end_headers()
            if self.command != "HEAD" and stream is not None:
                stream.seek(0)
                shutil.copyfileobj(stream, self.wfile)
            elif self.command != "HEAD":
                self.wfile.write(answer.body)
        finally:
            if stream is not None:
                stream.close()

    def _require_own(self) -> None:
        """Raise RefusedError for requests to another host name or from pages of another origin (DNS rebinding, CSRF)."""
        hosts = self.headers.get_all("Host") or []
        if len(hosts) != 1 or hosts[0].lower() not in self.server.names:
            raise RefusedError(HTTPStatus.FORBIDDEN, "this server has another name")
        origin = self.headers.get("Origin")
        if origin is not None and origin not in [f"http://{name}" for name in self.server.names]:
            raise RefusedError(HTTPStatus.FORBIDDEN, "other pages are not answered")

    def _site_of(self) -> tuple[Site, str, str]:
        """The site of the request's address, the path below it, and the query. Raises RefusedError without the token."""
        parts = urlsplit(self.path)
        first, _, path = unquote(parts.path, errors="strict").lstrip("/").partition("/")
        if not secrets.compare_digest(first.encode(), self.server.token.encode()):
            raise RefusedError(HTTPStatus.FORBIDDEN, "the address has not this server's token")
        number, slash, below = path.partition("/")
        if slash and number.isascii() and number.isdecimal() and 0 < int(number[:9]) < len(self.server.sites):
            return self.server.sites[int(number)], below, parts.query
        return self.server.sites[0], path, parts.query

    def _get(self) -> Answer:
        """Answer of a GET request: page, JSON of the API, node of the octree, or file. Raises RefusedError."""
        try:
            site, path, query = self._site_of()
            words = {name: values[-1] for name, values in parse_qs(query, max_num_fields=9).items()}
        except ValueError:
            raise RefusedError(HTTPStatus.BAD_REQUEST) from None
        if path in ("", "report.html"):
            return site.page()
        if path in site.gets:
            return _json(site.gets[path](words))
        node = site.node(path[len("tiles/") : -len(".bin")]) if path.startswith("tiles/r") else None
        return _file(site.folder, path) if node is None else Answer("application/octet-stream", node)

    def _post(self) -> Answer:
        """Answer of a POST request with a JSON body to the API. Raises RefusedError."""
        try:
            site, path, _ = self._site_of()
            size = int(self.headers.get("Content-Length", "-1"))
        except ValueError:
            raise RefusedError(HTTPStatus.BAD_REQUEST) from None
        if path not in site.posts:
            raise RefusedError(HTTPStatus.NOT_FOUND if path not in site.gets else HTTPStatus.METHOD_NOT_ALLOWED)
        if size < 0:
            raise RefusedError(HTTPStatus.LENGTH_REQUIRED)
        if size > MOST_BODY:
            raise RefusedError(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"more than {MOST_BODY} bytes")
        if self.headers.get_content_type() != "application/json":
            raise RefusedError(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "JSON is asked for")
        try:
            document = parse_json(self.rfile.read(size) or b"null")
        except ValueError:
            raise RefusedError(HTTPStatus.BAD_REQUEST, "this is no JSON") from None
        return _json(site.posts[path](document))


def _json(document: Any) -> Answer:
    """Answer with a document as JSON."""
    return Answer("application/json", json.dumps(strict(document), allow_nan=False).encode())


def _file(folder: Path, path: str) -> Answer:
    """Answer with a file inside the run folder; raises RefusedError for any other path."""
    try:
        root, file = folder.resolve(), (folder / path).resolve()
        is_ours = (
            not path.startswith("/") and ".." not in path.split("/") and file.is_relative_to(root) and file.is_file()
        )
    except (OSError, ValueError, RuntimeError):  # a NUL, a loop of links
        is_ours = False
    if not is_ours:
        raise RefusedError(HTTPStatus.NOT_FOUND)
    kind = KINDS.get(file.suffix.lower())
    # No script of a file that somebody laid there runs here.
    headers = (("Content-Security-Policy", "sandbox"), *(() if kind else (("Content-Disposition", "attachment"),)))
    return Answer(kind or "application/octet-stream", file=file, headers=headers)
