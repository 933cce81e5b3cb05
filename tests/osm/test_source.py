"""Buildings of a run: from a file, from a server during the run, from the replies of an earlier run."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stub_sequences import Stub

from lslam.core.config import Config
from lslam.core.config.backend import OsmConfig
from lslam.core.errors import InputError, UsageError
from lslam.core.geometry import geodesy, se2
from lslam.core.types.gnss import GnssStream
from lslam.osm import source
from lslam.osm.bounds import Bounds
from lslam.osm.source import OsmBuffer, OsmFile, OsmServer, open_osm

ORIGIN = np.array([49.0, 8.4, 115.0])


def street(bounds: Bounds) -> dict[str, Any]:
    """A house of 10 m at each thousandth of a degree, those inside the box."""
    elements: list[dict[str, Any]] = []
    for i in range(int(np.ceil(bounds.south * 1e3)), int(np.floor(bounds.north * 1e3)) + 1):
        for j in range(int(np.ceil(bounds.west * 1e3)), int(np.floor(bounds.east * 1e3)) + 1):
            number = 100_000 * i + j
            ring = [(0.0, 0.0), (0.0, 1e-4), (1e-4, 1e-4), (1e-4, 0.0)]
            ids = [10 * number + k for k in range(4)]
            elements += [
                {"type": "node", "id": n, "lat": i / 1e3 + a, "lon": j / 1e3 + b}
                for n, (a, b) in zip(ids, ring, strict=True)
            ]
            elements.append({"type": "way", "id": number, "nodes": [*ids, ids[0]], "tags": {"building": "yes"}})
    return {"elements": elements}


def drive(server: OsmServer, yaw: float = 0.0, length: float = 300.0) -> None:
    """Straight ahead in the world of odometry, a pose every 3 m."""
    for k, x in enumerate(np.arange(0.0, length, 3.0)):
        server.see(int(k * 3e8), se2.to_se3(np.array([x + 7.0, 5.0, 0.0])) @ se2.to_se3(np.array([0.0, 0.0, yaw])))


def asked_round(boxes: list[Bounds]) -> np.ndarray:
    """(R, 2) middles of the boxes, m east and north of the origin."""
    middles = [[(b.south + b.north) / 2, b.west + b.width / 2, 115.0] for b in boxes]
    return geodesy.to_local(np.array(middles), ORIGIN)[:, :2]


class Fetch:
    """Notes what is asked for."""

    def __init__(self) -> None:
        self.boxes: list[Bounds] = []

    def __call__(self, bounds: Bounds) -> dict[str, Any]:
        self.boxes.append(bounds)
        return street(bounds)


def test_with_a_heading_buildings_are_requested_along_the_path(tmp_path: Path) -> None:
    fetch = Fetch()
    server = OsmServer(ORIGIN, None, OsmConfig(heading_deg=0.0), fetch)
    server.begin(tmp_path / "replies")
    drive(server)
    found = server.extract(ORIGIN)
    middles = asked_round(fetch.boxes)
    assert np.abs(middles[:, 0]).max() < 1.0
    np.testing.assert_allclose(np.diff(middles[:, 1]), 63.0, atol=1.0)
    north = [b.middle[1] for b in found.buildings]
    assert max(north) > 300.0
    assert len({b.osm_id for b in found.buildings}) == len(found.buildings)
    again = OsmFile(tmp_path / "replies", ORIGIN).extract(ORIGIN)
    assert [b.osm_id for b in again.buildings] == [b.osm_id for b in found.buildings]


def test_fixes_determine_the_path_better_than_a_heading() -> None:
    fetch = Fetch()
    east = np.array([[d, 0.0, 0.0] for d in (0.0, 150.0, 300.0)])
    fixes = GnssStream(
        np.array([0, 15, 30], np.int64) * 10**9, geodesy.from_local(east, ORIGIN), np.ones(3)
    )  # fmt: skip
    server = OsmServer(ORIGIN, fixes, OsmConfig(heading_deg=0.0), fetch)
    server.begin(None)
    drive(server)
    server.extract(ORIGIN)
    middles = asked_round(fetch.boxes)
    assert np.abs(middles[:, 1]).max() < 1.0
    assert middles[:, 0].max() > 240.0


def test_invalid_fixes_are_ignored() -> None:
    fetch = Fetch()
    blind = GnssStream(
        np.arange(3, dtype=np.int64), np.array([[0.0, 0.0, 0.0], [np.nan] * 3, [91.0, 8.0, 0.0]]), np.ones(3)
    )
    server = OsmServer(ORIGIN, blind, OsmConfig(heading_deg=0.0), fetch)
    server.begin(None)
    drive(server)
    server.extract(ORIGIN)
    assert asked_round(fetch.boxes)[:, 1].max() > 240.0


def test_without_a_heading_the_circle_grows() -> None:
    fetch = Fetch()
    server = OsmServer(ORIGIN, None, OsmConfig(), fetch)
    server.begin(None)
    drive(server, yaw=1.0)
    assert max(np.linalg.norm(b.middle) for b in server.extract(ORIGIN).buildings) > 300.0 + 35.0
    assert np.abs(asked_round(fetch.boxes)).max() < 1.0
    assert len(fetch.boxes) == 4


def test_an_unreachable_server_is_reported_and_does_not_delay() -> None:
    """It is asked once for each circle and not once for each pose, and none is waited for when all have failed."""
    asked = []

    def fetch(bounds: Bounds) -> dict[str, Any]:
        asked.append(bounds)
        raise InputError("the line is dead")

    server = OsmServer(ORIGIN, None, OsmConfig(heading_deg=0.0), fetch)
    server.begin(None)
    drive(server)
    assert server.wait(60.0)
    with pytest.raises(InputError, match=r"no buildings from https://overpass-api\.de.*: the line is dead"):
        server.extract(ORIGIN)
    assert len(asked) == 5


def test_a_slow_server_is_waited_for_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The first reply comes, no other does; half a second later the run goes on with what it has."""
    gate = threading.Semaphore(1)

    def fetch(bounds: Bounds) -> dict[str, Any]:
        gate.acquire()
        return street(bounds)

    server = OsmServer(ORIGIN, None, OsmConfig(heading_deg=0.0), fetch)
    server.begin(tmp_path)
    drive(server)
    granted: list[tuple[float, int | None]] = []
    wait = OsmBuffer.wait

    def noted(buffer: OsmBuffer, seconds: float, requests: int | None = None) -> bool:
        granted.append((seconds, requests))
        return wait(buffer, seconds, requests)

    monkeypatch.setattr(OsmBuffer, "wait", noted)
    found = server.extract(ORIGIN)
    assert granted == [(60.0, 1), (0.5, None)]
    assert max(b.middle[1] for b in found.buildings) < 140.0
    assert [p.name for p in tmp_path.iterdir()] == ["000000.json"]
    monkeypatch.setattr(source, "FIRST_REPLY_S", 0.2)
    silent = OsmServer(ORIGIN, None, OsmConfig(heading_deg=0.0), fetch)
    silent.begin(None)
    with pytest.raises(InputError, match="no reply came in time"):
        silent.extract(ORIGIN)


def test_a_folder_without_replies_and_one_with_a_broken_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds no replies"):
        OsmFile(tmp_path, ORIGIN)
    endless = '{"elements": [{"type": "node", "id": 1e999}]}'
    for broken in ("[1]", '{"elements": null}', '{"elements": 7}', endless, "[" * 100_000):
        (tmp_path / "000000.json").write_text(broken)
        with pytest.raises(InputError, match=r"holds a reply that cannot be read"):
            OsmFile(tmp_path, ORIGIN)


@pytest.mark.parametrize("extract", ["auto", "town.osm"])
def test_coordinates_of_no_map_are_refused_before_any_building_is_read(extract: str) -> None:
    def opened(crs: int) -> Any:
        tree = {"osm": {"extract": extract, "origin": ORIGIN.tolist()}, "gnss": {"crs": crs}}
        return open_osm(Stub([]), Config.model_validate(tree))

    with pytest.raises(UsageError, match="does not count in metres on a plane"):
        opened(4326)
    if extract == "auto":
        assert isinstance(opened(25832), OsmServer)
    else:
        with pytest.raises(InputError, match=r"town\.osm"):
            opened(25832)
