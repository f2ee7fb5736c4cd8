"""Headless Chromium for tests of pages, which skip without it or without Playwright to drive it."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
SOFTWARE = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""WebGL without a graphics card."""
WINDOW = {"width": 800, "height": 600}
"""Without a graphics card a frame takes as long as it has pixels."""

playwright_api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
needed = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")


@contextmanager
def chromium() -> Iterator[Any]:
    with playwright_api.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=CHROMIUM, args=list(SOFTWARE))
        yield opened
        opened.close()
