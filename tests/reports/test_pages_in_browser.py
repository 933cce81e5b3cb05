"""Pages of localize, compare and merge as a browser shows them, and what a phone shows first."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import click, find, load, picture, settle
from comparisons import comparison, drawing
from merged_sessions import sessions, write
from test_html import scored
from test_localization_page import located

from lslam.core.types.run_record import RunRecord
from lslam.reports.compare_html import write_page
from lslam.reports.html import write_report

pytestmark = pytest.mark.slow

MOVED = 0.04  # share of pixels that are others
UNNAMED = (
    "return [...document.querySelectorAll('[tabindex], button, input, select')].filter(e => !(e.getAttribute('aria-label')"
    " || e.textContent.trim() || e.labels?.length)).map(e => e.outerHTML.slice(0, 80))"
)
GONE, NEW = np.array([214, 69, 65]), np.array([46, 134, 193])  # of categories.mjs
SESSIONS = (np.array([0, 99, 166]), np.array([209, 72, 10]))  # --c1 and --c2 of a light page


def said(browser: Any) -> str:
    return str(find(browser, "#said").text)


def share_of(shown: np.ndarray[Any, Any], colour: np.ndarray[Any, Any]) -> float:
    return float((np.abs(shown - colour).max(axis=2) < 8).mean())


def colour_by(browser: Any, name: str) -> None:
    script = "const s = document.querySelector('[name=colour]'); s.value = arguments[0]; s.dispatchEvent(new Event('change'))"
    browser.execute_script(script, name)


@pytest.fixture
def compared(tmp_path: Path) -> Path:
    write_page(tmp_path / "compare.html", comparison(tmp_path, sequences=("drive",)), [drawing(tmp_path)])
    return tmp_path / "compare.html"


@pytest.fixture
def on_map(make_record: Callable[..., RunRecord], tmp_path: Path) -> Path:
    """Page of a drive in an old map, a third of whose points are gone and a third not in it."""
    record = located(make_record, with_truth=False)
    assert record.map_sample is not None
    record.map_sample.columns["change"][:] = np.arange(900) % 3 - 1
    write_report(tmp_path / "report.html", record, None)
    return tmp_path / "report.html"


@pytest.mark.parametrize("width", [400, 1600])
def test_every_page_is_as_wide_as_the_screen_and_all_its_controls_have_names(
    browser: Any, compared: Path, on_map: Path, tmp_path: Path, width: int
) -> None:
    for page in (compared, on_map, write(tmp_path / "merge.html")):
        for dark in (False, True):
            load(browser, page, width, dark=dark)
            assert browser.get_log("browser") == []
            assert browser.execute_script("return document.documentElement.scrollWidth") <= width
            assert browser.execute_script(UNNAMED) == []


@pytest.mark.parametrize("width", [400, 1600])
def test_the_map_is_on_the_first_screen_and_the_bar_never_covers_it(
    browser: Any, make_record: Callable[..., RunRecord], tmp_path: Path, width: int
) -> None:
    """Of a run with much to say before the map."""
    problems = [f"{k} of 60 scans have a fault that takes a long sentence to be told to the reader" for k in range(9)]
    record = make_record(60, bad=dict.fromkeys(range(0, 60, 3), ("bridged", "too few inliers")), problems=problems)
    write_report(tmp_path / "report.html", record, scored(record))
    load(browser, tmp_path / "report.html", width)
    screen = 850
    size = {"width": width, "height": screen, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    settle(browser)
    boxes = "return ['.stage', '#now'].map(s => document.querySelector(s).getBoundingClientRect()).map(r => [r.top, r.bottom])"
    (top, bottom), (bar, _) = browser.execute_script(boxes)
    assert top < screen - 200
    assert bar >= bottom
    length = browser.execute_script("return document.documentElement.scrollHeight")
    stuck = 0
    for y in range(0, int(length), 97):
        browser.execute_script("window.scrollTo(0, arguments[0])", y)
        (top, bottom), (bar, end) = browser.execute_script(boxes)
        assert bar >= bottom or end <= top or bottom <= 0
        stuck += bar == 0
    assert stuck > 5, "it stays in sight over the charts"


def test_a_comparison_is_short_and_begins_with_its_table_and_errors(browser: Any, compared: Path) -> None:
    load(browser, compared)
    assert browser.execute_script("return document.documentElement.scrollHeight") <= 2000
    table, chart, stage = (find(browser, css).rect for css in ("table.sortable", ".half > svg", ".stage"))
    assert table["y"] + table["height"] < chart["y"]
    assert chart["y"] + chart["height"] < 1000
    assert stage["y"] + stage["height"] < 1100
    assert not find(browser, ".crops").is_displayed()
    find(browser, "details:has(.crops) > summary").click()
    assert find(browser, ".crops svg, .crops img").is_displayed()


def test_its_table_is_sorted_by_mouse_and_keys(browser: Any, compared: Path) -> None:
    load(browser, compared)

    def column() -> list[str]:
        return [
            cell.text
            for cell in browser.find_elements("css selector", "table.sortable:first-of-type tbody tr td:nth-child(2)")
        ][:2]

    head = find(browser, "table.sortable th:nth-child(3)")
    button = head.find_element("css selector", "button")
    assert (head.get_attribute("aria-sort"), column()) == ("none", ["icp", "kiss-icp"])
    button.click()
    assert (head.get_attribute("aria-sort"), column()) == ("ascending", ["icp", "kiss-icp"])
    button.send_keys("\n")
    assert (head.get_attribute("aria-sort"), column()) == ("descending", ["kiss-icp", "icp"])
    button.send_keys(" ")
    assert (head.get_attribute("aria-sort"), column()) == ("none", ["icp", "kiss-icp"])


def test_a_switch_takes_a_method_out_of_every_chart_and_off_the_map(browser: Any, compared: Path) -> None:
    load(browser, compared)
    line = find(browser, ".half > svg .line.s2")
    both = picture(browser)
    assert line.is_displayed()
    box = find(browser, "input[data-style=s2]")
    assert box.find_element("xpath", "..").text == "kiss-icp"
    box.send_keys(" ")
    assert not line.is_displayed()
    one = picture(browser)
    assert share_of(both, SESSIONS[1]) > 2 * share_of(one, SESSIONS[1])
    box.send_keys(" ")
    assert line.is_displayed()
    assert (both != picture(browser)).any(axis=2).mean() < MOVED / 4


def test_merged_runs_have_a_colour_each_and_are_seen_before_and_after(browser: Any, tmp_path: Path) -> None:
    load(browser, write(tmp_path / "merge.html"))
    after = picture(browser)
    views = sessions()
    for view, colour in zip(views, SESSIONS, strict=True):
        # Floor beside the session's own way, on the side where no other went.
        place = [30.0, view.after[0, 1] + (3 if view is views[1] else -3), 0.0]
        x, y = (round(v) for v in browser.execute_script("return [...mapView.project(arguments[0])]", place))
        seen = np.median(after[y - 3 : y + 4, x - 3 : x + 4].reshape(-1, 3), axis=0)
        assert np.dot(seen, colour) / np.linalg.norm(seen) / np.linalg.norm(colour) > 0.99, (
            "one colour, more or less bright"
        )
    way = "return [...mapView.project(arguments[0])]"
    for word, where in (("before", views[0].before), ("after", views[0].after)):
        click(browser, f"button[data-ways={word}]")
        settle(browser)
        assert find(browser, f"button[data-ways={word}]").get_attribute("aria-pressed") == "true"
        drawn = browser.execute_script("return [...sessions.sessions[0].way]")
        expected = browser.execute_script(way, where.ravel().tolist())
        assert drawn == pytest.approx(expected, abs=0.1)
    click(browser, "input[data-style=s2]")
    assert (after != picture(browser)).any(axis=2).mean() > 0.001
    colour_by(browser, "height")
    assert (after != picture(browser)).any(axis=2).mean() > MOVED


def test_what_differs_from_the_old_map_is_seen_in_two_colours_and_scans_say_what_held_them(
    browser: Any, on_map: Path
) -> None:
    load(browser, on_map)
    shown = picture(browser)
    assert share_of(shown, GONE) > 0.0005
    assert share_of(shown, NEW) > 0.0005
    colour_by(browser, "height")
    assert share_of(picture(browser), NEW) < 0.0001
    for k, words in (
        (5, "held by the map"),
        (15, "the map has changed there"),
        (35, "carried by odometry: beyond the map"),
    ):
        browser.execute_script("mark(arguments[0])", k)
        settle(browser)
        assert words in said(browser)
