"""The buffer never waits: slow, dead and lying servers cost the caller nothing, and a second run repeats the first."""

from __future__ import annotations

import json
import queue
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from overpass_server import FakeOverpass, house, running

from lslam.core.config.backend import OsmConfig
from lslam.core.errors import InputError
from lslam.core.types.building import Building
from lslam.io.formats.osm_buildings import buildings_of
from lslam.osm.bounds import Bounds
from lslam.osm.overpass import fetch_buildings, merge_replies
from lslam.osm.source import OsmBuffer
from lslam.osm.walls import OsmMap

ORIGIN = np.array([49.0112, 8.4229, 112.8])
DRIVE = np.column_stack([np.arange(0.0, 400.0, 2.0), np.zeros(200)])


def street(bounds: Bounds) -> dict[str, Any]:
    """A house every 10 m or so along the line of latitude of the origin, those inside the box."""
    step = 2e-4
    first, last = int(np.ceil(bounds.west / step)), int(np.floor(bounds.east / step))
    return {"elements": [e for k in range(first, last + 1) for e in house(k, ORIGIN[0] + 1e-4, k * step)]}


class Server:
    """A fetch whose replies are let go one by one."""

    def __init__(self, reply: Callable[[Bounds], dict[str, Any]] = street) -> None:
        self.reply = reply
        self.asked: list[Bounds] = []
        self.gate = threading.Semaphore(0)

    def __call__(self, bounds: Bounds) -> dict[str, Any]:
        self.asked.append(bounds)
        self.gate.acquire()
        return self.reply(bounds)

    def let_go(self, buffer: OsmBuffer) -> None:
        self.gate.release()
        assert buffer.wait(5.0)


def near(buffer: OsmBuffer, place: np.ndarray) -> list[Building]:
    """Ask for the surroundings of a place; the buildings within 35 m of it that are here."""
    buffer.ask(place)
    data = merge_replies(buffer.replies)
    town = OsmMap(buildings_of(data, ORIGIN).buildings)
    return [town.buildings[number] for number in town.near(place, 35.0)]


@pytest.fixture
def server() -> Iterator[FakeOverpass]:
    with running() as fake:
        yield fake


def test_nothing_is_there_before_the_reply_and_everything_near_after_it() -> None:
    server = Server()
    with OsmBuffer(server, ORIGIN, OsmConfig()) as buffer:
        assert near(buffer, np.zeros(2)) == []
        server.let_go(buffer)
        found = near(buffer, np.zeros(2))
        corners = np.array([np.linalg.norm(b.footprints[0].outer, axis=1).min() for b in found])
        assert 3 <= len(found) <= 6
        assert corners.max() <= 35.0 + 8.0
        west = [b.middle[0] for b in near(buffer, np.array([-50.0, 0.0]))]
        assert max(west) < -10.0
        assert min(west) > -95.0


def test_a_new_circle_is_asked_for_only_outside_the_sixty_metres() -> None:
    server = Server()
    with OsmBuffer(server, ORIGIN, OsmConfig()) as buffer:
        for position in DRIVE:
            buffer.ask(position)
            if buffer.is_waiting:
                server.let_go(buffer)
            assert len(near(buffer, position)) >= 3, "within 60 m of 120 m there is always something to use"
        for position in DRIVE[::-1]:
            buffer.ask(position)
        buffer.wait(5.0)
    assert len(server.asked) == 7, "at 0, 62, 124, ... m, and nothing on the way back"
    widths = [box.width * 111_320 * np.cos(np.radians(49)) for box in server.asked]
    np.testing.assert_allclose(widths, 240, rtol=0.01)


def test_a_slow_server_does_not_block_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its one open request is never answered, and nobody but the buffer's own thread ever waits for a message."""
    caller, waits = threading.get_ident(), list[float | None]()

    class Watched(queue.SimpleQueue[Any]):
        def get(self, block: bool = True, timeout: float | None = None) -> Any:
            if block and self.empty() and threading.get_ident() == caller:
                waits.append(timeout)
            return super().get(block, timeout)

    monkeypatch.setattr("lslam.osm.source.queue", SimpleNamespace(SimpleQueue=Watched, Empty=queue.Empty))
    server = Server()
    with OsmBuffer(server, ORIGIN, OsmConfig()) as buffer:
        for position in DRIVE:
            assert near(buffer, position) == []
        assert waits == []
        assert not buffer.wait(0.1)
        assert sum(seconds or 0.0 for seconds in waits) == pytest.approx(0.1)
    assert len(server.asked) == 1
    server.gate.release(100)


def test_a_failed_or_invalid_reply_is_reported_once_per_circle(
    server: FakeOverpass, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    server.script = ["html", "elsewhere", "redirect", "cut"]
    config = OsmConfig(server=server.url, attempts=1)
    with (
        caplog.at_level("WARNING", logger="lslam"),
        OsmBuffer(lambda box: fetch_buildings(box, config, tmp_path / "cache"), ORIGIN, config, tmp_path / "run") as b,
    ):
        for position in DRIVE[:120]:
            assert near(b, position) == []
            b.wait(5.0)
    assert len(server.requests) == 4
    assert [p.split(": ")[-1] for p in b.problems[:2]] == ["check osm.server", "check osm.server"]
    assert "web page" in b.problems[0]
    assert len(b.problems) == 4
    assert not (tmp_path / "run").exists()
    assert len(caplog.records) == 4


def test_invalid_replies_do_not_end_the_run() -> None:
    server = Server(lambda _: {"elements": [{"type": "way", "id": 1, "nodes": [{}], "tags": {"building": "yes"}}]})
    with OsmBuffer(server, ORIGIN, OsmConfig()) as buffer:
        buffer.ask(np.zeros(2))
        server.let_go(buffer)
        assert near(buffer, np.zeros(2)) == []
    assert len(buffer.problems) == 1


def test_a_run_that_goes_on_uses_the_replies_it_has_and_asks_only_for_others(tmp_path: Path) -> None:
    server = Server()
    with OsmBuffer(server, ORIGIN, OsmConfig(), tmp_path) as first:
        for position in DRIVE[:60]:
            first.ask(position)
            if first.is_waiting:
                server.let_go(first)
        seen = [b.osm_id for b in near(first, DRIVE[59])]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["000000.json", "000001.json"]
    asked = len(server.asked)
    with OsmBuffer(server, ORIGIN, OsmConfig(), tmp_path) as second:
        assert [b.osm_id for b in near(second, DRIVE[59])] == seen
        assert second.wait(0.1)
        assert len(server.asked) == asked
        for position in DRIVE:
            second.ask(position)
            if second.is_waiting:
                server.let_go(second)
        assert [list(one.items_of()) for one in second.replies[:asked]] == [
            list(one.items_of()) for one in first.replies
        ]
    assert len(server.asked) == 7, "as one that was not killed"
    (tmp_path / "000000.json").write_text(json.dumps({"elements": []}))
    with pytest.raises(InputError, match=r"000000.json is no reply kept by an earlier run"):
        OsmBuffer(server, ORIGIN, OsmConfig(), tmp_path)


def test_a_reply_after_the_deadline_is_not_kept(tmp_path: Path) -> None:
    server = Server()
    with OsmBuffer(server, ORIGIN, OsmConfig(), tmp_path) as buffer:
        buffer.ask(np.zeros(2))
        server.let_go(buffer)
        buffer.ask(np.array([70.0, 0.0]))
    server.gate.release()
    time.sleep(0.2)
    assert [p.name for p in tmp_path.iterdir()] == ["000000.json"]
    assert len(buffer.replies) == 1


def test_a_larger_circle_is_asked_for_once() -> None:
    server = Server()
    with OsmBuffer(server, ORIGIN, OsmConfig()) as buffer:
        for radius in (None, 120.0, 240.0, 240.0, 200.0):
            buffer.ask(np.zeros(2), radius)
            if buffer.is_waiting:
                server.let_go(buffer)
        assert len(near(buffer, np.array([170.0, 0.0]))) >= 3
    assert len(server.asked) == 2
