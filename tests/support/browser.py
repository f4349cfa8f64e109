"""A real Chromium for the tests of pages: without a screen, its graphics in software."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--hide-scrollbars", "--force-device-scale-factor=1",
    "--disable-gpu-rasterization", "--disable-gpu-compositing",
)  # fmt: skip
"""Only WebGL is left to the graphics in software: pages that they put together too take more than twice the time."""

SECONDS = 60.0
"""Until a small page is ready; it takes 1 s where nothing else runs."""

OWN = ("file:", "data:", "blob:", "about:", "chrome:")
"""Beginnings of addresses that lead nowhere outside."""


@contextmanager
def open_browser(*flags: str, width: int = 900, height: int = 700) -> Iterator[Any]:
    """Start Chromium with a window of a size; skip where it, its driver or selenium is missing."""
    program, driver_path = shutil.which("chromium"), shutil.which("chromedriver")
    if program is None or driver_path is None or find_spec("selenium") is None:
        if os.environ.get("CLRECON_REQUIRE_BROWSER"):
            pytest.fail("CLRECON_REQUIRE_BROWSER is set: chromium, chromedriver or selenium is missing")
        pytest.skip("needs selenium and a browser: apt-get install chromium chromium-driver")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = program
    for flag in (*FLAGS, f"--window-size={width},{height}", *flags):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(driver_path))
    try:
        yield driver
    finally:
        driver.quit()


def wait_for(driver: Any, script: str, *, seconds: float = SECONDS) -> Any:
    """Ask a page until it answers with something; fail after a time."""
    end = time.monotonic() + seconds
    while not (found := driver.execute_script(script)):
        assert time.monotonic() < end, f"not within {seconds:g} s: {script}"
        time.sleep(0.05)
    return found


def open_page(driver: Any, path: Path) -> int:
    """Open a page and wait until its surface is drawn; returns the milliseconds that it says it took."""
    driver.get(path.as_uri())
    return int(wait_for(driver, "return document.documentElement.dataset.ready"))


def outside_requests(driver: Any) -> list[str]:
    """Addresses outside of the page that it asked for since the last call."""
    events = [json.loads(entry["message"])["message"] for entry in driver.get_log("performance")]
    asked = [event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"]
    return [address for address in asked if not address.startswith(OWN)]


def severe_lines(driver: Any) -> list[str]:
    """Errors that the browser logged since the last call."""
    return [entry["message"] for entry in driver.get_log("browser") if entry["level"] == "SEVERE"]
