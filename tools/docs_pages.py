# SPDX-License-Identifier: Apache-2.0
"""Make the documents' pictures of pages: ``viewer.jpg`` of a finished run, ``live.jpg`` of one that goes on.

python tools/docs_pages.py RUN [--out docs/images] [--frame 14]

RUN is a run folder of the built-in office, as ``tools/docs_images.py`` leaves it. Both are what a browser
shows: Chromium (``apt-get install chromium``) driven by Playwright. It draws on the CPU in a minute or two.
"""

from __future__ import annotations

import argparse
import io
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from browsing import PATIENCE, find_browser, open_browser
from ggwarp import load_run
from ggwarp.editing.device import ready_device
from ggwarp.editing.map_view import MapView, best_views
from ggwarp.editing.selection import select
from ggwarp.io.atomic import atomic_write
from ggwarp.results.saved_run import RunError
from ggwarp.viewer import scene
from ggwarp.viewer.build import open_page
from ggwarp.viewer.server import LOCAL, stop_server

_WIDTH, _HEIGHT = 1280, 800
_SELECTED = "desk"
_LEFT = 0.3  # of its distance
_SCALE = 0.42  # of 1200 x 680
_DRAWN = 20_000  # milliseconds for the browser's last picture
_QUALITY = 80


def write_viewer(run_folder: Path, path: Path, program: str) -> None:
    """Write the page of a finished run as ``path``: an object selected, seen from where it is largest."""
    run = load_run(run_folder)
    record = run.find(_SELECTED)
    chosen = select(run.gaussians, record.id)
    page, _, url = open_page(run, LOCAL, 0, device=ready_device("cpu"))
    (best,) = best_views(MapView(run.gaussians, run.camera), run.poses, chosen, count=1)
    try:
        with open_browser(program, _WIDTH, _HEIGHT) as tab:
            tab.goto(url)
            _wait(tab, lambda: bool(page.server.get_clients()))
            client = next(iter(page.server.get_clients().values()))
            T_wc = run.poses[best]
            scene.look_from(client.camera, T_wc, scene.field_of_view(run.camera))
            # Left of the middle, as the panel is on the right.
            away = np.array(record.centre) - T_wc[:3, 3]
            client.camera.look_at = record.centre + _LEFT * np.linalg.norm(away) * T_wc[:3, 0]
            page.session.select(record.id)
            page.ask(client, page.session_changed)
            tab.get_by_text(f"(object {record.id})").wait_for()
            _wait(tab, lambda: tab.locator("img").count() >= len(run.objects) // 2)
            _write(tab, path)
    finally:
        stop_server(page.server)


def write_live(path: Path, program: str, frame: int, scale: float = _SCALE) -> None:
    """Write the page of a run of the office as ``path``, held at ``frame`` or as soon after as it is shown.

    Raises:
        RunError: the run shows no page.
    """
    with tempfile.TemporaryDirectory() as folder:
        options = ["--seq", "office", "--scale", str(scale), "--device", "cpu", "--viewer-at", f"{LOCAL}:0"]
        command = [sys.executable, "-m", "ggwarp", "run", *options, "--out", f"{folder}/run"]
        run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        try:
            with open_browser(program, _WIDTH, _HEIGHT) as tab:
                tab.goto(_address(run))
                tab.get_by_text(re.compile(rf"Frame ({frame}|{frame + 1}|{frame + 2})\b")).wait_for()
                tab.get_by_role("button", name="Pause", exact=True).click()
                tab.get_by_text("paused", exact=True).wait_for()
                _write(tab, path)
        finally:
            run.kill()
            run.wait()


def _address(run: subprocess.Popen[str]) -> str:
    """Return the address of its page that ``run`` says."""
    assert run.stdout is not None
    for line in run.stdout:
        if found := re.search(r"http://\S+token=\S+", line):
            return found[0]
    raise RunError("the run showed no page")


def _wait(tab: Any, what: Callable[[], bool]) -> None:
    """Let the browser work until ``what``.

    Raises:
        RunError: it took too long.
    """
    end = time.monotonic() + PATIENCE / 1000.0
    while not what():
        if time.monotonic() > end:
            raise RunError("the browser shows nothing; is the machine busy?")
        tab.wait_for_timeout(100)


def _write(tab: Any, path: Path) -> None:
    """Write what the window shows, without the notice that WebGL is drawn on the CPU."""
    notices = tab.locator(".mantine-Notification-closeButton")
    for _ in range(notices.count()):
        notices.first.click()
    tab.wait_for_timeout(_DRAWN)
    picture = Image.open(io.BytesIO(tab.screenshot())).convert("RGB")
    with atomic_write(path) as file:
        picture.save(file, "JPEG", quality=_QUALITY)
    print(path)


def main(arguments: list[str] | None = None) -> int:
    """Make both."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("run", type=Path, help="run folder of the built-in office")
    parser.add_argument("--out", type=Path, default=Path("docs/images"), help="folder of the pictures")
    parser.add_argument("--frame", type=int, default=14, help="at which the run is shown")
    options = parser.parse_args(arguments)
    program = find_browser()
    if program is None:
        parser.error("no Chromium is installed; try apt-get install chromium")
    try:
        write_viewer(options.run, options.out / "viewer.jpg", program)
        write_live(options.out / "live.jpg", program, options.frame)
    except RunError as error:
        print(f"docs_pages: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
