"""The map of a page in a browser: every control, measuring, sections, depth, and how fast a million points turn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import click, find, load, picture, settle

from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.run_record import RunRecord
from lslam.reports.html import write_report
from lslam.reports.png import palette

MOVED = 0.04  # share of pixels that are others
FRAMES_A_SECOND = 10  # by software alone


def town(rng: np.random.Generator, count: int) -> ArrayCloud:
    """A floor 1.7 m below the sensor, and a wall of 6 m along the road at its southern side."""
    floor = rng.uniform((-10, -5, -1.7), (60, 35, -1.68), (count, 3))
    wall = rng.uniform((-10, -4, -1.7), (60, -3.9, 4.3), (count // 4, 3))
    points = np.concatenate([floor, wall])
    rgb = {name: np.full(len(points), value, np.uint8) for name, value in (("red", 200), ("green", 30), ("blue", 90))}
    labels = np.repeat(np.array([40, 50], np.uint16), [count, count // 4])
    return ArrayCloud(points, rng.uniform(0, 1, len(points)).astype(np.float32), {**rgb, "class": labels})


@pytest.fixture
def page(make_record: Callable[..., RunRecord], tmp_path: Path) -> Path:
    """A report of such a map."""
    write_report(tmp_path / "report.html", make_record(40, map_sample=town(np.random.default_rng(2), 40_000)), None)
    return tmp_path / "report.html"


def choose(browser: Any, name: str, value: object) -> None:
    """Set a control of the map to a value, as a user does."""
    browser.execute_script(
        "const input = document.querySelector(`.tools [name=${arguments[0]}]`);"
        "if (input.type === 'checkbox') input.checked = arguments[1]; else input.value = arguments[1];"
        "for (const kind of ['input', 'change']) input.dispatchEvent(new Event(kind));",
        name,
        value,
    )
    settle(browser)


def press(browser: Any, *place: float) -> None:
    """Click what is seen of a point of the world, m."""
    browser.execute_script(
        "const [x, y] = mapView.project(arguments[0]); const canvas = document.querySelector('canvas.lines');"
        "const box = canvas.getBoundingClientRect();"
        "for (const kind of ['pointerdown', 'pointerup'])"
        " canvas.dispatchEvent(new PointerEvent(kind, { clientX: box.left + x, clientY: box.top + y, pointerId: 1 }));",
        list(place),
    )
    settle(browser)


def measured(browser: Any) -> str:
    return str(find(browser, ".measured").text)


def without_capture(browser: Any) -> None:
    """A pointer that no mouse moves cannot be captured."""
    browser.execute_script("Element.prototype.setPointerCapture = () => {}")


@pytest.mark.parametrize(("width", "dark"), [(400, True), (1600, False)])
def test_every_control_of_the_map_does_something(browser: Any, page: Path, width: int, dark: bool) -> None:
    load(browser, page, width, dark=dark)
    click(browser, "[data-do=turn]")
    before = picture(browser)
    for name, value, back in (
        ("from", 60, 2), ("to", 40, 98), ("size", 4, 1), ("shade", False, True), ("colour", "camera colours", "height"),
        ("colour", "class", "height"), ("colour", "intensity", "height"), ("colour", "time", "height"),
        ("section", "way", ""),
    ):  # fmt: skip
        choose(browser, name, value)
        assert (before != picture(browser)).any(axis=2).mean() > MOVED / 4, name
        choose(browser, name, back)
    assert (before != picture(browser)).any(axis=2).mean() < MOVED / 4
    for there, back in (("in", "out"), ("in", "reset")):
        click(browser, f"[data-do={there}]")
        assert (before != picture(browser)).any(axis=2).mean() > MOVED / 4, there
        click(browser, f"[data-do={back}]")
        assert (before != picture(browser)).any(axis=2).mean() < MOVED / 4, back
    size = find(browser, ".stage").size
    find(browser, "[data-do=fill]").click()  # by the mouse: a script alone may not
    settle(browser)
    filled = find(browser, ".stage").size
    assert browser.execute_script("return document.fullscreenElement === mapView.figure")
    assert filled["width"] >= size["width"]
    assert filled["height"] > size["height"]
    find(browser, "[data-do=fill]").click()
    settle(browser)
    assert find(browser, ".stage").size == size
    assert find(browser, ".tools details").get_attribute("open") == (None if width == 400 else "true")
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    assert browser.get_log("browser") == []


def test_two_clicks_measure_and_keys_do_too(browser: Any, page: Path) -> None:
    load(browser, page)
    without_capture(browser)
    click(browser, "[data-do=measure]")
    press(browser, 10, 10, -1.7)
    press(browser, 40, 10, -1.7)
    distance, level, height = (float(part.replace("−", "-").split()[-1]) for part in measured(browser).split(" m")[:3])
    assert distance == pytest.approx(30, abs=0.6)
    assert level == pytest.approx(30, abs=0.6)
    assert abs(height) < 0.05
    canvas = find(browser, "canvas.lines")
    canvas.send_keys("\n")
    settle(browser)
    assert measured(browser).startswith("From ")
    click(browser, "[data-do=measure]")
    assert measured(browser) == ""
    assert find(browser, "[data-do=measure]").get_attribute("aria-pressed") == "false"


def test_a_section_along_a_line_shows_the_wall_from_the_side(browser: Any, page: Path) -> None:
    load(browser, page)
    without_capture(browser)
    choose(browser, "colour", "class")
    choose(browser, "width", 2)
    choose(browser, "section", "line")
    press(browser, 0, -3.95, 4.3)
    press(browser, 50, -3.95, 4.3)
    x0, x1, z0, z1 = browser.execute_script("return mapView.sides")
    assert x1 - x0 == pytest.approx(50, abs=1)
    assert (z0, z1) == (pytest.approx(-1.7, abs=0.1), pytest.approx(4.3, abs=0.1))
    shown = picture(browser)
    wall = np.array([230, 159, 0])  # second colour: the less frequent label
    rows, columns = np.nonzero(np.abs(shown - wall).max(axis=2) < 60)
    # A wall of 50 m by 6 m fills its rectangle, and points reach beyond it by half their size.
    size = browser.execute_script("return 2 * mapView.spacing / mapView.camera.metres")
    assert (np.ptp(columns) - size) / (np.ptp(rows) - size) == pytest.approx(50 / 6, rel=0.05)
    click(browser, "[data-do=flat]")
    assert find(browser, ".tools [name=section]").get_attribute("value") == ""
    assert measured(browser) == ""


def test_the_trajectory_hides_behind_a_wall_in_3d_alone(browser: Any, page: Path) -> None:
    load(browser, page)
    orange = np.array([209, 72, 10])

    def way(shown: Any) -> int:
        return int((np.abs(shown - orange).max(axis=2) < 30).sum())

    # From the south, low: the wall stands before the first part of the drive, which goes along y = 0.
    browser.execute_script("mapView.turnTo(0, 1.35)")
    behind = way(picture(browser))
    browser.execute_script("mapView.turnTo(Math.PI, 1.35)")
    before = way(picture(browser))
    assert behind < 0.75 * before


def test_edges_are_shaded_by_depth(browser: Any, page: Path) -> None:
    load(browser, page)
    browser.execute_script("mapView.turnTo(0.6, 0.95)")
    shaded = picture(browser)
    choose(browser, "shade", False)
    bare = picture(browser)
    # The wall's foot is darker, the open floor is not.
    assert (shaded.sum(axis=2) < bare.sum(axis=2) - 30).mean() > 0.005
    assert np.median(np.abs(shaded - bare)) == 0


def test_the_drawing_comes_back_when_the_graphics_unit_goes(browser: Any, page: Path) -> None:
    load(browser, page)
    assert not find(browser, ".stage svg").is_displayed()
    browser.execute_script("mapView.drawer.gl.getExtension('WEBGL_lose_context').loseContext()")
    browser.execute_async_script("setTimeout(arguments[0], 200)")
    browser.execute_script("mapView.zoom(2); mapView.reset()")
    settle(browser)
    assert find(browser, ".stage svg").is_displayed()
    assert browser.find_elements("css selector", ".stage canvas") == []
    assert not find(browser, ".tools").is_displayed()


def test_a_million_points_turn_by_software_and_rest_whole(
    browser: Any, make_record: Callable[..., RunRecord], tmp_path: Path
) -> None:
    record = make_record(40)
    cloud = town(np.random.default_rng(3), 800_000)
    write_report(tmp_path / "report.html", replace(record, map_sample=cloud), None)
    load(browser, tmp_path / "report.html", 1280)
    click(browser, "[data-do=turn]")
    browser.set_script_timeout(60)
    painted = browser.execute_async_script(
        "const done = arguments[0]; const times = []; const paint = mapView.paint.bind(mapView); const began = performance.now();"
        "mapView.paint = () => { times.push(performance.now() - began); paint(); };"
        "const turn = () => { mapView.move(4, 0, false);"
        " if (performance.now() - began < 5000) requestAnimationFrame(turn); else done(times); }; requestAnimationFrame(turn);"
    )
    late = [time for time in painted if time > 2500]
    assert (len(late) - 1) / (late[-1] - late[0]) * 1000 >= FRAMES_A_SECOND
    settle(browser)
    low = palette()[0].astype(int)
    assert (np.abs(picture(browser) - low).max(axis=2) < 40).mean() > 0.1
