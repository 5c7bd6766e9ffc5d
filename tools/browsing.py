# SPDX-License-Identifier: Apache-2.0
"""A real browser without a screen: Debian's Chromium, driven by Playwright."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_SOFTWARE_WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PATIENCE = 120_000.0
"""Milliseconds: a busy machine draws a picture of WebGL in many seconds."""


def find_browser() -> str | None:
    """Return the path of a Chromium; None: there is none."""
    return next((path for name in _NAMES if (path := shutil.which(name))), None)


@contextmanager
def open_browser(path: str, width: int, height: int) -> Iterator[Any]:
    """Yield a page of Playwright's, of this size in pixels, which draws WebGL on the CPU.

    Args:
        path: of the browser's program.

    Raises:
        ImportError: Playwright is not installed.
    """
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        arguments = [*_SOFTWARE_WEBGL, "--no-sandbox"]
        browser = driver.chromium.launch(executable_path=path, args=arguments)
        try:
            page = browser.new_page(viewport={"width": width, "height": height})
            page.context.set_default_timeout(PATIENCE)
            yield page
        finally:
            browser.close()
