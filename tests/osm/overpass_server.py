"""A server on loopback that answers as Overpass does, and in the ways in which servers go wrong."""

from __future__ import annotations

import gzip
import json
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs

PAGE = b"<!DOCTYPE html><html><body>The gateway is having a rest.</body></html>"


def house(number: int, lat: float, lon: float, size: float = 1e-4) -> list[dict[str, Any]]:
    """A square building of about 10 m with its lower left corner at a place."""
    corners = [(lat, lon), (lat, lon + size), (lat + size, lon + size), (lat + size, lon)]
    nodes = [{"type": "node", "id": 10 * number + k, "lat": a, "lon": b} for k, (a, b) in enumerate(corners)]
    ring = [node["id"] for node in nodes]
    return [{"type": "way", "id": number, "nodes": [*ring, ring[0]], "tags": {"building": "yes"}}, *nodes]


class FakeOverpass:
    """Answers each request with the next of `script`, and in good order when that is used up.

    Words of the script: ok, busy, busy:SECONDS, gateway, drop, html, cut, remark, elsewhere, redirect, forbidden, empty,
    slow:SECONDS, drip:SECONDS (from byte to byte), header:SECONDS (likewise, before the body), torn, zipped.
    `requests` keeps the queries and headers; `most_at_once` how many were open together.
    """

    def __init__(self) -> None:
        self.script: list[str] = []
        self.requests: list[tuple[str, dict[str, str]]] = []
        self.url = ""
        self.open = self.most_at_once = 0
        self.lock = threading.Lock()

    def reply(self, query: str) -> bytes:
        south, west, north, east = map(float, re.findall(r"-?\d+\.\d+", query)[:4])
        found = house(1, (south + north) / 2, (west + east) / 2) + house(2, south + 1e-5, west + 1e-5)
        return json.dumps({"version": 0.6, "generator": "Overpass API", "elements": found}).encode()


@contextmanager
def running() -> Iterator[FakeOverpass]:
    """The server in a thread, for the length of the block."""
    fake = FakeOverpass()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"])).decode()
            with fake.lock:
                fake.requests.append((parse_qs(body)["data"][0], dict(self.headers)))
                word = fake.script.pop(0) if fake.script else "ok"
                fake.open += 1
                fake.most_at_once = max(fake.most_at_once, fake.open)
            with suppress(OSError):  # the client has left
                _answer(self, fake, word, fake.requests[-1][0])

        def log_message(self, *_: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    fake.url = f"http://127.0.0.1:{server.server_port}/api/interpreter"
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield fake
    finally:
        server.shutdown()
        server.server_close()


def _answer(handler: BaseHTTPRequestHandler, fake: FakeOverpass, word: str, query: str) -> None:
    kind, _, value = word.partition(":")
    good = fake.reply(query)
    if kind == "slow":
        time.sleep(float(value))
    # Before the first byte: a client that has its answer may ask again at once.
    with fake.lock:
        fake.open -= 1
    if kind == "drop":
        handler.close_connection = True
        return
    if kind == "header":
        for byte in b"HTTP/1.1 200 OK\r\nX-Patience: " + b"a" * 2000:
            handler.wfile.write(bytes([byte]))
            time.sleep(float(value))
    status = {"busy": 429, "gateway": 504, "redirect": 301, "forbidden": 403}.get(kind, 200)
    body = {
        "html": PAGE,
        "gateway": PAGE,
        "cut": good[: len(good) // 2],
        "remark": json.dumps({"elements": [], "remark": "runtime error: Query timed out"}).encode(),
        "elsewhere": json.dumps({"elements": house(1, -33.0, 151.0)}).encode(),
        "empty": json.dumps({"elements": []}).encode(),
    }.get(kind, good if status == 200 else b"")
    handler.send_response(status)
    if kind == "busy" and value:
        handler.send_header("Retry-After", value)
    if kind == "redirect":
        handler.send_header("Location", "https://portal.example/login")
    if kind == "zipped":
        body = gzip.compress(body)
        handler.send_header("Content-Encoding", "gzip")
    handler.send_header("Content-Type", "application/json")
    handler.send_header("Content-Length", str(len(body)))
    handler.end_headers()
    if kind == "drip":
        for byte in body:
            handler.wfile.write(bytes([byte]))
            time.sleep(float(value))
    handler.wfile.write(body[: len(body) // 2] if kind == "torn" else body)
