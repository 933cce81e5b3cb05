"""Loops and points corrected on the page: every control clicked, as a file and served, without complaints of the browser."""

from __future__ import annotations

import csv
import io
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

# Skipped with it where there is no browser.
from browsing import browser, click, find, hover, load, picture, settle  # noqa: F401 (a fixture)

from lslam.cli.main import cli
from lslam.core.geometry import se3
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.constraint import Constraint, LoopCandidate, LoopStage, Verdict
from lslam.core.types.run_record import PairView, RunRecord
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.pipeline.view.server import RunServer
from lslam.pipeline.view.sites import ViewedSites
from lslam.reports.html import write_report

pytestmark = pytest.mark.slow
SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
DRIFT = ("debug.drift=true", "debug.drift_percent=4", "debug.drift_deg_per_100m=12")
SCANS = 60
TRUE, FALSE = np.array([1.0, -2.0, 0.0]), np.array([6.0, 3.0, 0.0])


def facts(page: Any) -> str:
    return str(find(page, "#corrections .facts").text)


def said(page: Any) -> list[str]:
    lines = page.find_elements("css selector", "#corrections .said li")
    return [line.text.removesuffix("Remove").strip() for line in lines]


def until(page: Any, holds: Callable[[], bool], seconds: float = 60.0) -> None:
    for _ in range(int(10 * seconds)):
        if holds():
            return
        time.sleep(0.1)
    raise AssertionError(find(page, "#corrections").text)


def click_map(page: Any, point: list[float]) -> None:
    """Click where the world's point is seen."""
    canvas = find(page, "canvas.lines")
    x, y = page.execute_script(f"return [...mapView.project({point})]")
    hover(page, canvas, x, y)
    from selenium.webdriver.common.action_chains import ActionChains

    ActionChains(page, duration=0).click().perform()
    settle(page)


@pytest.fixture
def page_of_file(make_record: Callable[..., RunRecord], tmp_path: Path) -> tuple[Path, RunRecord]:
    """A wall seen from two places. One candidate was rejected, whose clouds registration brings together; another is unseen."""
    wall = np.random.default_rng(0).uniform((-8, 3, 0), (8, 3.2, 3), (900, 3)).astype(np.float32)
    ends = Constraint(2, 25, se3.make(np.eye(3), TRUE), np.eye(6) * 1e-4)
    rejected = LoopCandidate(
        2, 25, 31.0, 0.2, Verdict.REJECTED, LoopStage.GATE, "odometry <i>would</i> be wrong", 0.05, 0.8, ends
    )
    accepted = LoopCandidate(1, 20, 20.0, 0.2, Verdict.ACCEPTED, LoopStage.AGREEMENT, "", 0.04, 0.9, ends)
    thinned = LoopCandidate(1, 21, 20.0, 0.2, Verdict.REJECTED, LoopStage.THINNED, "not tried")
    before, after = (se3.make(np.eye(3), t) for t in (FALSE, TRUE))
    rng = np.random.default_rng(0)
    record = make_record(
        SCANS,
        loops=[accepted, rejected, thinned],
        keyframe_scans=np.arange(0, SCANS, 2),
        pair_views=[PairView(rejected, wall, (wall - TRUE).astype(np.float32), before, after)],
        map_sample=ArrayCloud.of(rng.uniform((-10, -5, 0), (60, 35, 0.1), (40_000, 3))),
    )
    write_report(tmp_path / "report.html", record, None)
    return tmp_path / "report.html", record


@pytest.mark.parametrize(("width", "dark"), [(400, True), (1600, False)])
def test_candidates_are_listed_seen_and_judged(browser: Any, page_of_file: Any, width: int, dark: bool) -> None:  # noqa: F811
    page, _ = page_of_file
    load(browser, page, width, dark=dark)
    rows = [row.text for row in browser.find_elements("css selector", "#corrections tbody tr")]
    assert len(rows) == 2, "what was not tried is no candidate"
    assert rows[0].startswith("4 – 50")
    assert "odometry <i>would</i> be wrong" in rows[0]
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    click(browser, "#corrections tbody button")
    assert facts(browser).startswith("Scans 4 and 50; rejected: odometry <i>would</i> be wrong")
    # Registered, the wall is one; before, two that are apart.
    canvas = "#corrections canvas.both"
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", find(browser, canvas))
    after = picture(browser, canvas)
    click(browser, "[data-see=before]")
    before = picture(browser, canvas)
    rows_of = [np.flatnonzero((np.abs(shown - shown[0, 0]).max(axis=2) > 40).any(axis=1)) for shown in (after, before)]
    assert np.ptp(rows_of[1]) > 3 * np.ptp(rows_of[0])
    click(browser, "[data-see=side]")
    assert (picture(browser, canvas) != before).any(axis=2).mean() > 0.01
    pressed = {
        name: find(browser, f"[data-see={name}]").get_attribute("aria-pressed")
        for name in ("after", "before", "above", "side")
    }
    assert [name for name, is_on in pressed.items() if is_on == "true"] == ["before", "side"]
    click(browser, "[data-see=above]")
    find(browser, canvas).send_keys(".")
    assert (picture(browser, canvas) != before).any(axis=2).mean() > 0.01, "the full stop switches too"
    assert find(browser, "[data-see=after]").get_attribute("aria-pressed") == "true"
    for word, line in (("known", ["4 – 50 known"]), ("forbidden", ["4 – 50 forbidden"]), ("", [])):
        click(browser, f"[data-say='{word}']")
        assert said(browser) == line
    click(browser, "[data-by=poses]")
    first = find(browser, "#corrections tbody tr").text
    assert first.startswith("2 – 40")
    for name in ("doubt", "verdict", "overlap", "reason"):
        click(browser, f"[data-by={name}]")
        assert find(browser, f"th:has([data-by={name}])").get_attribute("aria-sort") in ("ascending", "descending")
    unnamed = browser.execute_script(
        "return [...document.querySelectorAll('#corrections :is([tabindex], button, input)')]"
        ".filter(e => !(e.getAttribute('aria-label') || e.textContent.trim() || e.labels?.length))"
        ".map(e => e.outerHTML.slice(0, 80))"
    )
    assert unnamed == []
    assert browser.get_log("browser") == []


def test_the_map_says_why_and_picks_scans_and_points(browser: Any, page_of_file: Any) -> None:  # noqa: F811
    page, record = page_of_file
    load(browser, page)
    places = record.trajectory.positions
    middle = (0.5 * (places[4] + places[50])).tolist()
    canvas = find(browser, "canvas.lines")
    hover(browser, canvas, *browser.execute_script(f"return [...mapView.project({middle})]"))
    assert find(browser, ".loop-said").text == "Scans 4 and 50, rejected: odometry <i>would</i> be wrong"
    click_map(browser, middle)
    assert find(browser, "tr.chosen").text.startswith("4 – 50")
    click(browser, "[data-pick=pair]")
    assert find(browser, "[data-pick=pair]").get_attribute("aria-pressed") == "true"
    click_map(browser, places[30].tolist())
    assert find(browser, ".outcome").text == "Scan 30: now the other one"
    click_map(browser, places[12].tolist())
    assert facts(browser).startswith("Scans 12 and 30")
    assert "lslam view shows them" in facts(browser)
    click(browser, "[data-say=forbidden]")
    # A point beside the way, and the LiDAR itself.
    browser.execute_script("document.querySelector('.point').open = true")
    T = record.trajectory.poses[20]
    point = se3.apply(T, np.array([[0.0, 4.0, 0.0]]))[0]
    for place in (point, places[20]):
        click(browser, "[data-pick=point]")
        click_map(browser, [*place[:2].tolist(), 0.05])
        form = find(browser, ".point form")
        for name, text in (("x", "458000.5"), ("y", "5430000"), ("z", "115"), ("crs", "EPSG:25832")):
            field = form.find_element("name", name)
            field.clear()
            field.send_keys(text)
        seen = find(browser, ".seen").text
        click(browser, ".point form button:not([type])")
        if place is point:
            assert "seen from its LiDAR at" in seen
    assert seen == "the LiDAR itself"
    assert said(browser)[0] == "12 – 30 forbidden"
    assert len(said(browser)) == 3
    browser.execute_script(
        "URL.createObjectURL = blob => { blob.text().then(text => { window.written = text }); return '#' }"
    )
    texts = {}
    for name in ("edits.csv", "points.csv"):
        click(browser, f"[data-file='{name}']")
        settle(browser)
        texts[name] = browser.execute_script("return window.written")
    assert texts["edits.csv"] == "scan_a,scan_b,verdict\n12,30,forbidden\n"
    first, second = csv.DictReader(io.StringIO(texts["points.csv"]))
    at = np.array([float(first[f"lidar_{axis}"]) for axis in "xyz"])
    there = record.trajectory.poses[int(first["scan"])]
    np.testing.assert_allclose(se3.apply(there, at[None])[0, :2], point[:2], atol=0.6)
    assert (second["scan"], second["lidar_x"], second["sigma"]) == ("20", "0", "0.05")
    # What is typed wrongly is said, and nothing is added.
    find(browser, "form.pair input[name=a]").clear()
    find(browser, "form.pair input[name=a]").send_keys("400")
    click(browser, "form.pair button:not([type])")
    assert find(browser, ".outcome.bad").text == "scan 400 is none of the run's"
    click(browser, ".said li button")
    assert len(said(browser)) == 2
    assert browser.get_log("browser") == []


@pytest.fixture(scope="module")
def lost(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose odometry drifts: it ends where it began, and no loop says so."""
    run = tmp_path_factory.mktemp("viewed") / "lost"
    words = ["run", str(SAMPLE), "--out", str(run), "-q", *(word for setting in DRIFT for word in ("--set", setting))]
    cli(words, standalone_mode=False)
    return run


@pytest.fixture
def url(lost: Path) -> Iterator[str]:
    with RunServer() as server:
        sites = ViewedSites(server)
        sites.add(lost)
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        yield server.url
        server.shutdown()
        sites.stop()


class Address(str):
    """As the path of a page, for `load`."""

    def as_uri(self) -> str:
        return str(self)


def test_served_a_known_pair_mends_the_run(browser: Any, url: str, lost: Path) -> None:  # noqa: F811
    load(browser, Address(url))  # type: ignore[arg-type]
    assert not find(browser, "[data-file]").is_displayed()
    until(browser, lambda: find(browser, "[data-graph=run]").is_displayed())
    # Nearer, finer nodes of the map are drawn, and points of them are picked.
    until(browser, lambda: "points are loaded" in find(browser, ".tiles-said").text)
    browser.execute_script("mapView.zoom(20)")
    until(
        browser,
        lambda: browser.execute_script("return mapView.names.includes('map') && mapView.names.some(n => n.length > 2)"),
    )
    place = browser.execute_script(
        "const c = tiles.held.get(tiles.wanted.at(-1)); return [...mapView.project(coordinates(c))].slice(0, 2)"
    )
    assert browser.execute_script(f"return mapView.pick({place[0]}, {place[1]})") is not None
    browser.execute_script("mapView.reset()")
    for name, text in (("a", "0"), ("b", "94")):
        field = find(browser, f"form.pair input[name={name}]")
        field.clear()
        field.send_keys(text)
    click(browser, "form.pair button:not([type])")
    until(browser, lambda: "as a known pair they close a loop" in facts(browser))
    click(browser, "[data-say=known]")
    until(browser, lambda: "Written: 1 in edits.csv" in find(browser, ".outcome").text)
    assert (lost / "edits.csv").read_text() == "scan_a,scan_b,verdict\n0,94,known\n"
    click(browser, "[data-graph=run]")
    until(browser, lambda: find(browser, "[data-graph=stop]").is_displayed())
    click(browser, "[data-graph=stop]")
    until(browser, lambda: find(browser, ".outcome").text == "lslam graph was stopped")
    map_before = picture(browser)
    click(browser, "[data-graph=run]")
    until(browser, lambda: "The new run: " in find(browser, ".change").text)
    assert (picture(browser) != map_before).any(axis=2).mean() > 0.002, "its way is on the map"
    # Opened again, the page knows what was said and done.
    load(browser, Address(url))  # type: ignore[arg-type]
    until(browser, lambda: said(browser) == ["0 – 94 known"])
    until(browser, lambda: "The new run: " in find(browser, ".change").text)
    name = find(browser, ".change a").text
    click(browser, ".change a")
    until(browser, lambda: "/1/" in browser.current_url and said(browser) == ["0 – 94 known"])
    assert browser.get_log("browser") == []
    new = read_trajectory(lost.with_name(name) / "trajectory.tum", "tum")
    old = read_trajectory(lost / "trajectory.tum", "tum")
    assert np.linalg.norm(new.positions[94] - old.positions[94]) > 2.0
