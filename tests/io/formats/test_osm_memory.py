"""What reading an extract costs beside what it holds."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lslam.io.formats.osm_data import OsmData
from lslam.io.formats.osm_files import read_osm, write_osm
from lslam.osm.bounds import Bounds
from lslam.osm.overpass import OverpassReply, _file_name, from_overpass, kept_reply, merge_replies

HOUSES = 6_000
BOX = Bounds(48.95, 8.35, 49.05, 8.45)
MB = 1e6


def town() -> dict[str, Any]:
    elements: list[dict[str, Any]] = []
    for k in range(HOUSES):
        lat, lon, first = 49 + 1e-5 * (k % 300), 8.4 + 1e-5 * (k // 300), 10 * k + 1
        corners = [(0, 0), (4e-6, 0), (4e-6, 7e-6), (0, 7e-6)]
        elements += [
            {"type": "node", "id": first + i, "lat": round(lat + a, 7), "lon": round(lon + b, 7)}
            for i, (a, b) in enumerate(corners)
        ]
        nodes = [first, first + 1, first + 2, first + 3, first]
        tags = {"building": "yes", "name": f"house {k}"}
        elements.append({"type": "way", "id": first + 8, "nodes": nodes, "tags": tags})
    return {"version": 0.6, "elements": elements, "osm3s": {"copyright": "ODbL"}}


@pytest.fixture(scope="module")
def extracts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("extracts")
    tree = town()
    (folder / "town.json").write_text(json.dumps(tree))
    (folder / _file_name(BOX)).write_text(json.dumps(tree))
    write_osm(folder / "town.osm", from_overpass(tree))
    return folder


def cost(read: Callable[[], Any]) -> tuple[Any, float, float]:
    """What is read, and the memory that it holds and that it took at most, MB."""
    tracemalloc.start()
    try:
        found = read()
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    return found, held / MB, peak / MB


@pytest.mark.parametrize("name", ["town.json", "town.osm"])
def test_a_file_costs_hardly_more_than_what_is_in_it(extracts: Path, name: str) -> None:
    data, held, peak = cost(lambda: read_osm(extracts / name))
    assert (len(data.nodes), len(data.ways)) == (4 * HOUSES, HOUSES)
    assert held > 2 * (extracts / name).stat().st_size / MB
    assert peak < 1.1 * held + 1


def test_a_reply_is_held_as_its_text(extracts: Path) -> None:
    size = (extracts / _file_name(BOX)).stat().st_size / MB
    data, of_data, _ = cost(lambda: read_osm(extracts / "town.json"))
    reply, held, peak = cost(lambda: kept_reply(BOX, extracts))
    assert isinstance(reply, OverpassReply)
    assert held < 1.1 * size + 0.5
    assert peak < 1.1 * (size + of_data) + 1.5  # its elements are looked at, then forgotten
    assert from_overpass(reply) == data
    assert json.loads(reply.text) == town()


def test_many_replies_make_one_extract_that_costs_what_it_holds(extracts: Path) -> None:
    text = (extracts / "town.json").read_bytes()
    data, held, peak = cost(lambda: merge_replies([OverpassReply(text)] * 3))
    assert isinstance(data, OsmData)
    assert len(data.ways) == HOUSES
    assert peak < 1.1 * held + 1
