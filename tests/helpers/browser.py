# SPDX-License-Identifier: Apache-2.0
"""A real browser without a screen, for tests of pages; they are skipped where there is none."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import browsing
from browsing import PATIENCE as PATIENCE

_CONSOLE = re.compile(r"CONSOLE[^\]]*\]\s*(.*)")


def find_browser() -> str:
    """Return the path of a Chromium; skip the test where there is none."""
    found = browsing.find_browser()
    if found is None:
        pytest.skip("no browser: apt-get install chromium")
    return found


@contextmanager
def open_browser(width: int = 1280, height: int = 800) -> Iterator[Any]:
    """Yield a page of Playwright's, of this size, which draws WebGL on the CPU."""
    path = find_browser()
    pytest.importorskip("playwright.sync_api", reason="no playwright: pip install playwright")
    with browsing.open_browser(path, width, height) as page:
        yield page


def opened(page: Path, folder: Path) -> tuple[str, list[str]]:
    """Return the document after its scripts have run, and the console's lines; by the browser alone.

    Args:
        page: a file.
        folder: for the browser's own files.
    """
    options = [
        *("--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--enable-logging=stderr"),
        *("--disable-background-networking", "--allow-file-access-from-files", "--virtual-time-budget=4000"),
        *(f"--user-data-dir={folder}", "--dump-dom"),
    ]
    done = subprocess.run(
        [find_browser(), *options, page.as_uri()], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, _CONSOLE.findall(done.stderr)
