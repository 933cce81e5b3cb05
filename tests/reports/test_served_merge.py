"""`lslam view` of merged runs: their page, all points of their map in the colours of the sessions, and nothing to correct."""

from __future__ import annotations

import json
import logging
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import find, picture, settle
from merged_sessions import sessions, write

from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.trajectory_lines import write_tum
from lslam.maps.octree import points_of
from lslam.pipeline.map_files import MapNote, write_map
from lslam.pipeline.view.server import RunServer
from lslam.pipeline.view.sites import ViewedSites, require_page
from lslam.reports.shell import RUN, script_of

STEP_M = 0.1  # between points of the floor: many more than the page has


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as `lslam merge` leaves it, of two sessions over one floor."""
    folder = tmp_path_factory.mktemp("merged") / "town"
    (folder / "sessions").mkdir(parents=True)
    for view in sessions():
        poses = se3.make(np.tile(np.eye(3), (len(view.after), 1, 1)), view.after)
        write_tum(folder / "sessions" / f"{view.name}.tum", Trajectory(10**8 * np.arange(len(poses)), poses))
    x, y = np.meshgrid(np.arange(-10, 70, STEP_M), np.arange(-15, 25, STEP_M))
    floor = ArrayCloud.of(np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]))
    write_map(folder / "map.ply", floor, MapNote("monday, tuesday", STEP_M))
    write(folder / "report.html")
    rows = [{"name": view.name, "run": str(folder.parent / view.name)} for view in sessions()]
    (folder / "manifest.json").write_text(json.dumps({"kind": "merge", "status": "done", "sessions": rows}))
    return folder


@pytest.fixture
def url(town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with RunServer() as server:
        sites = ViewedSites(server)
        sites.add(town)
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        yield server.url
        server.shutdown()
        sites.stop()


def ask(address: str, document: Any = None) -> tuple[int, bytes]:
    body = None if document is None else json.dumps(document).encode()
    request = urllib.request.Request(address, body, {"Content-Type": "application/json"})
    try:
        with urllib.request.urlopen(request, timeout=60) as reply:
            return reply.status, reply.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def tree_at(url: str) -> dict[str, Any]:
    for _ in range(600):
        tree: dict[str, Any] = json.loads(ask(f"{url}tiles/tree.json")[1])
        if "nodes" in tree:
            return tree
        time.sleep(0.05)
    raise AssertionError(tree)


def test_its_points_know_the_session_that_came_nearest(url: str) -> None:
    tree = tree_at(url)
    assert tree["points"] == 800 * 400
    _, data = ask(f"{url}tiles/r0.bin")
    count = tree["nodes"]["r0"]
    points, owner = points_of("r0", data[: 6 * count], tree), np.frombuffer(data[-4 * count :], "<u4")
    away = [np.linalg.norm(points[:2000, None] - view.after, axis=2).min(axis=1) for view in sessions()]
    is_clear = np.abs(away[0] - away[1]) > 0.01
    assert is_clear.sum() > 1000
    np.testing.assert_array_equal(owner[:2000][is_clear], np.argmin(away, axis=0)[is_clear])
    assert set(owner.tolist()) == {0, 1}


def test_its_page_is_served_and_corrections_are_refused_in_a_sentence(town: Path, url: str) -> None:
    before = {path: path.stat().st_mtime_ns for path in town.rglob("*")}
    status, page = ask(url)
    assert status == 200
    assert script_of(RUN).digest in page.decode()
    assert "connect-src 'self'" in page.decode()
    for name in ("api/edits", "api/graph"):
        status, reply = ask(f"{url}{name}", {"pairs": [], "points": []})
        said = json.loads(reply)["error"]
        assert (status, said) == (
            422,
            f"{town} is a merge, whose loops cannot be corrected: correct its runs with lslam view, and merge them again",
        )
    assert {path: path.stat().st_mtime_ns for path in town.rglob("*")} == before


def test_the_command_says_it_too_and_a_merge_that_failed_is_named(
    town: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.getLogger("lslam"), "propagate", True)
    with caplog.at_level(logging.INFO, "lslam"):
        require_page(town)
    assert "is a merge, whose loops cannot be corrected" in caplog.text
    (tmp_path / "manifest.json").write_text('{"kind": "merge", "status": "failed"}')
    with pytest.raises(InputError, match=r"manifest\.json: sessions.*merge the runs again"):
        require_page(tmp_path)


@pytest.mark.slow
def test_more_points_have_the_colours_of_their_sessions(browser: Any, url: str) -> None:
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": 1600, "height": 1300, "deviceScaleFactor": 1, "mobile": False},
    )
    tree_at(url)
    browser.get(url)
    settle(browser)
    for _ in range(600):
        if browser.execute_script("return tiles.held.size > 0 && tiles.asked.size === 0"):
            break
        time.sleep(0.1)
    else:
        raise AssertionError(find(browser, ".tiles-said").text)
    settle(browser)
    assert browser.execute_script("return mapView.way_of_colour") == "session"
    # What the page holds by itself is taken away: the tiles alone are seen.
    browser.execute_script(
        "const map = mapView.drawer.clouds.get('map'); map.cloud = { ...map.cloud, count: 0 };"
        " mapView.isShaded = false; mapView.draw()"
    )
    shown = picture(browser)
    for colour in (np.array([0, 99, 166]), np.array([209, 72, 10])):  # --c1 and --c2 of a light page
        assert (np.abs(shown - (0.75 * colour)).max(axis=2) < 60).mean() > 0.1
    assert browser.get_log("browser") == []
