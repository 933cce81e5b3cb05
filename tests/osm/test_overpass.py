"""Requests to an Overpass server and checks of its replies."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from overpass_server import FakeOverpass, running

from lslam.core.config.backend import OsmConfig
from lslam.core.errors import InputError
from lslam.osm.bounds import Bounds
from lslam.osm.overpass import OverpassReply, fetch_buildings, from_overpass, kept_reply, query

BOX = Bounds(49.0, 8.4, 49.01, 8.42)


@pytest.fixture
def server() -> Iterator[FakeOverpass]:
    with running() as fake:
        yield fake


def fetch(fake: FakeOverpass, folder: Path, *script: str, bounds: Bounds = BOX, **changes: Any) -> OverpassReply:
    """One call against the next words of the script, without waiting between attempts."""
    fake.script = list(script)
    fake.requests.clear()
    config = OsmConfig(**{"server": fake.url, "timeout": 5.0, "attempts": 3, **changes})
    waits: list[float] = []
    try:
        return fetch_buildings(bounds, config, folder, waits.append)
    finally:
        fetch.waits = waits  # type: ignore[attr-defined]


def test_the_query_is_that_of_the_conventions_with_a_user_agent_of_our_own(
    server: FakeOverpass, tmp_path: Path
) -> None:
    tree = fetch(server, tmp_path)
    assert len(from_overpass(tree).ways) == 2
    ((asked, headers),) = server.requests
    box = "49.000000,8.400000,49.010000,8.420000"
    assert asked == (
        f'[out:json][timeout:5];(way["building"]({box});relation["building"]["type"="multipolygon"]({box}););'
        "out body;>;out skel qt;"
    )
    assert headers["User-Agent"].startswith("lslam/")


def test_a_place_is_requested_once(server: FakeOverpass, tmp_path: Path) -> None:
    first = fetch(server, tmp_path).text
    assert fetch(server, tmp_path).text == first
    assert server.requests == []
    inside = Bounds(49.002, 8.405, 49.004, 8.41)
    assert fetch(server, tmp_path, bounds=inside).text == first, "a larger box that is kept will do"
    assert server.requests == []
    fetch(server, tmp_path, bounds=Bounds(49.002, 8.405, 49.012, 8.41))
    assert len(server.requests) == 1, "this one looks out of it"
    fetch(server, tmp_path, cache="refresh")
    assert len(server.requests) == 1


def test_without_network_only_what_is_kept(server: FakeOverpass, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no reply for 49\.000000"):
        fetch(server, tmp_path, cache="only")
    kept = fetch(server, tmp_path).text
    dead = "http://127.0.0.1:9/api"
    assert fetch(server, tmp_path, server=dead, cache="only").text == kept
    assert fetch(server, tmp_path, server=dead).text == kept
    assert fetch(server, tmp_path, server=dead, cache="refresh").text == kept, "an old reply is better than none"
    with pytest.raises(InputError, match=r"127.0.0.1:9/api cannot be reached: check the network"):
        fetch(server, tmp_path, server=dead, bounds=Bounds(50.0, 8.4, 50.01, 8.42))
    assert fetch.waits == [], "nobody waits for a server that is not there"  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("script", "waits"),
    [
        (["busy", "gateway", "ok"], [5.0, 10.0]),
        (["busy:7", "ok"], [7.0]),
        (["busy:²", "ok"], [5.0]),
        (["drop", "ok"], [5.0]),
        (["cut", "remark", "ok"], [5.0, 10.0]),
    ],
)
def test_a_busy_server_is_asked_again_later(
    server: FakeOverpass, tmp_path: Path, script: list[str], waits: list[float]
) -> None:
    assert len(from_overpass(fetch(server, tmp_path, *script)).ways) == 2
    assert fetch.waits == waits  # type: ignore[attr-defined]
    assert len(server.requests) == len(script)
    assert kept_reply(BOX, tmp_path) is not None


@pytest.mark.parametrize(
    ("word", "sentence", "requests"),
    [
        ("busy", r"after 3 attempts: it is busy \(HTTP 429\); try later", 3),
        ("busy:4000", "asks for a long break", 1),
        ("drop", "after 3 attempts: the connection broke", 3),
        ("cut", "after 3 attempts: the reply was cut short", 3),
        ("remark", r"it gave up \(runtime error: Query timed out\)", 3),
        ("html", "answered with a web page, not with data: check osm.server", 1),
        ("redirect", "redirects to https://portal.example/login: set osm.server", 1),
        ("forbidden", r"refused the request \(HTTP 403\)", 1),
        ("elsewhere", "most of it lies elsewhere, about -32.9", 1),
        ("slow:2", "did not answer within 0.3 s", 1),
        ("drip:0.05", "did not answer within 0.3 s", 1),
        ("header:0.05", "did not answer within 0.3 s", 1),
        ("busy:\u00b2", r"after 3 attempts: it is busy", 3),
        ("torn", "after 3 attempts: the connection broke", 3),
    ],
)
def test_permanent_failures_are_one_sentence_and_are_not_cached(
    server: FakeOverpass, tmp_path: Path, word: str, sentence: str, requests: int
) -> None:
    timeout = 0.3 if word.startswith(("slow", "drip", "header")) else 5.0
    begun = time.monotonic()
    with pytest.raises(InputError, match=sentence) as caught:
        fetch(server, tmp_path, *[word] * 3, timeout=timeout)
    assert "\n" not in str(caught.value)
    assert time.monotonic() - begun < 20.0, "a reply that comes drop by drop lasts for half a minute"
    assert len(server.requests) == requests
    assert list(tmp_path.glob("*.json*")) == []


def test_a_reply_may_be_compressed(server: FakeOverpass, tmp_path: Path) -> None:
    assert len(from_overpass(fetch(server, tmp_path, "zipped")).ways) == 2


def test_a_place_without_buildings_is_an_answer(server: FakeOverpass, tmp_path: Path) -> None:
    assert list(fetch(server, tmp_path, "empty").items_of()) == []
    assert list(fetch(server, tmp_path, "busy").items_of()) == []
    assert server.requests == []


def test_a_damaged_cache_costs_a_request_and_no_more(server: FakeOverpass, tmp_path: Path) -> None:
    fetch(server, tmp_path)
    (path,) = tmp_path.glob("*.json")
    path.write_bytes(path.read_bytes()[:100])
    assert len(from_overpass(fetch(server, tmp_path)).ways) == 2
    assert len(server.requests) == 1
    assert json.loads(path.read_bytes())["elements"]
    stranger = tmp_path / "49.0,8.4,49.01-of-somebody.json"
    stranger.write_text("{}")
    assert kept_reply(Bounds(60.0, 8.4, 60.01, 8.42), tmp_path) is None


def test_one_request_at_a_time(server: FakeOverpass, tmp_path: Path) -> None:
    server.script = ["slow:0.15"] * 3
    boxes = [Bounds(49.0 + k, 8.4, 49.01 + k, 8.42) for k in range(3)]
    config = OsmConfig(server=server.url)
    threads = [threading.Thread(target=fetch_buildings, args=(box, config, tmp_path)) for box in boxes]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(server.requests) == 3
    assert server.most_at_once == 1


def test_a_reply_that_is_too_long_is_an_error(
    server: FakeOverpass, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lslam.osm.overpass.LONGEST_REPLY", 500)
    with pytest.raises(InputError, match="the reply grows beyond"):
        fetch(server, tmp_path)


def test_the_query_depends_on_the_timeout_and_boxes_are_rounded() -> None:
    assert query(BOX, 180) != query(BOX, 60)
    near = Bounds(49.0 + 1e-9, 8.4, 49.01, 8.42)
    assert near == BOX
    np.testing.assert_allclose(BOX.area_km2, 1.112 * 1.4604, rtol=2e-3)
