"""A headless browser for tests of pages, and what they do in it."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--hide-scrollbars", "--force-device-scale-factor=1",
)  # fmt: skip


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium without a window; skips without selenium, chromium and chromedriver."""
    webdriver = pytest.importorskip("selenium.webdriver")
    pytest.importorskip("PIL.Image")
    if not (BROWSER and DRIVER):
        pytest.skip("no chromium with chromedriver")
    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for flag in FLAGS:
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


def load(browser: Any, page: Path, width: int = 1600, *, dark: bool = False, media: str = "") -> None:
    size = {"width": width, "height": 1300, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": media, "features": [scheme]})
    browser.get(page.as_uri())
    settle(browser)


def settle(browser: Any) -> None:
    """Until two more frames are drawn, and a map with all its points."""
    browser.execute_async_script(
        "const done = arguments[0];"
        "const isDrawn = () => typeof mapView === 'undefined' || !mapView?.isFitted || mapView.drawn === 1;"
        "const wait = () => requestAnimationFrame(() => (isDrawn() ? requestAnimationFrame(() => done()) : wait()));"
        "requestAnimationFrame(wait);"
    )


def find(browser: Any, selector: str) -> Any:
    return browser.find_element("css selector", selector)


def picture(browser: Any, selector: str = ".stage") -> np.ndarray[Any, Any]:
    from PIL import Image

    settle(browser)
    return np.asarray(Image.open(io.BytesIO(find(browser, selector).screenshot_as_png)).convert("RGB"), int)


def click(browser: Any, selector: str) -> None:
    browser.execute_script("arguments[0].click()", find(browser, selector))


def hover(browser: Any, element: Any, x: float, y: float) -> None:
    """Move the pointer to px within an element."""
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
    from selenium.webdriver.common.action_chains import ActionChains

    box = element.rect
    at = (round(x - box["width"] / 2), round(y - box["height"] / 2))
    ActionChains(browser, duration=0).move_to_element_with_offset(element, *at).perform()
    settle(browser)
