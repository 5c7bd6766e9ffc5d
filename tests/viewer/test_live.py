# SPDX-License-Identifier: Apache-2.0
"""The page during a run: what it shows, what it costs, and that the run does not notice."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from browser import open_browser
from ggwarp import run
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.results.saved_run import load_run
from ggwarp.types import Frame, StepReport, Verdict
from ggwarp.viewer import live
from ggwarp.viewer.live import Budget, LiveViewer, ShownDisplay
from small_run import CAMERA

PATIENCE = 60.0


class System:
    """A map that does not grow, and a folder that says it was saved."""

    def __init__(self, scene: Any) -> None:
        self.map = GaussianMap(device="cpu", has_identity=False, capacity=len(scene))
        self.map.append(scene)
        self.camera, self.mapping_scope = CAMERA, nullcontext()
        self.saved: list[Path] = []

    def save(self, folder: str | Path, names: dict[int, str] | None = None) -> None:
        self.saved.append(Path(folder))


@pytest.fixture
def viewer(scene: Any, tmp_path: Path) -> Iterator[LiveViewer]:
    made = LiveViewer("127.0.0.1", 0)
    made.begin(System(scene), tmp_path / "run")
    yield made
    made.close()


def _frame(index: int) -> tuple[Frame, StepReport]:
    T_wc = np.eye(4)
    T_wc[0, 3] = 0.01 * index
    picture = np.full((CAMERA.height, CAMERA.width, 3), index % 256, np.uint8)
    values: dict[str, Any] = dict.fromkeys(["rmse", "tracking_ms", "mapping_ms", "loss", "overlap"], 0.5)
    step = StepReport(
        index, 0.1 * index, T_wc, Verdict.LOST if index == 3 else Verdict.CONVERGED, "", keyframe="",
        mapping_iterations=1, gaussians=9, **values,
    )  # fmt: skip
    return Frame(index, 0.1 * index, picture), step


def _never() -> bool:
    return False


def test_a_budget_is_a_share_of_the_time():
    now = [0.0]
    budget = Budget(0.1, clock=lambda: now[0])
    assert budget.is_left
    with budget.spending():
        now[0] += 1.0
    assert not budget.is_left
    now[0] = 9.9
    assert not budget.is_left
    now[0] = 10.1
    assert budget.is_left


def test_it_is_said_what_of_the_map_is_not_shown(viewer, scene):
    frame, step = _frame(2)
    for total, is_said in ((len(scene), False), (len(scene) + 70, True)):
        viewer._send(viewer._system, frame, dataclasses.replace(step, gaussians=total))
        assert (f"{len(scene)} of {total} Gaussians" in viewer._title.content) is is_said


def test_nothing_is_sent_where_nobody_looks(viewer):
    for index in range(5):
        assert viewer.show(*_frame(index), _never) == 0.0
    assert viewer.updates == {"frames": 0, "pictures": 0, "maps": 0}


def test_pause_step_and_go_on(viewer):
    viewer._press("Pause")
    shown: list[float] = []
    done = threading.Event()

    def run_on() -> None:
        for index in range(3):
            shown.append(viewer.show(*_frame(index), _never))
        done.set()

    threading.Thread(target=run_on, daemon=True).start()
    time.sleep(0.3)
    assert shown == []
    viewer._press("Step")
    assert _wait(lambda: len(shown) == 1) and shown[0] > 0.2
    time.sleep(0.3)
    assert len(shown) == 1
    viewer._press("Go on")
    assert done.wait(PATIENCE) and shown[2] == 0.0


def test_a_signal_ends_a_pause(viewer):
    viewer._press("Pause")
    assert viewer.show(*_frame(0), lambda: True) >= 0.0


def test_save_now_saves_beside_the_run(viewer, tmp_path):
    viewer._press("Save now")
    viewer.show(*_frame(7), _never)
    assert viewer._system.saved == [tmp_path / "run-frame000007"]
    viewer.show(*_frame(8), _never)
    assert len(viewer._system.saved) == 1


def test_the_display_is_shown_too(viewer):
    heard: list[tuple[str, Any]] = []
    inner: Any = SimpleNamespace(
        **{name: lambda *a, name=name: heard.append((name, a[0])) for name in ("note", "warn", "conclude")},
        stage=lambda name, total=None: heard.append(("stage", name)),
        advance=lambda status="": heard.append(("advance", status)),
    )
    display = ShownDisplay(inner, viewer)
    display.note("a `b`")
    display.warn("amiss")
    display.stage("frames", 3)
    display.advance("2.0 fps")
    assert heard == [("note", "a `b`"), ("warn", "amiss"), ("stage", "frames"), ("advance", "2.0 fps")]
    assert "warning: amiss" in viewer._log.content and "2.0 fps" in viewer._pace.content
    assert "frames" in viewer._stage.content


def test_a_run_that_is_watched_has_the_same_bits(tmp_path, monkeypatch):
    """Even where all is sent at every frame."""
    monkeypatch.setattr(live, "_PICTURES", 1e9)
    monkeypatch.setattr(live, "_MAP", 1e9)
    seen: list[LiveViewer] = []
    begin = LiveViewer.begin

    def watched(self: LiveViewer, system: Any, folder: Path) -> None:
        monkeypatch.setattr(
            self.server, "get_clients", lambda: {0: SimpleNamespace(camera=SimpleNamespace())}
        )
        seen.append(self)
        begin(self, system, folder)

    monkeypatch.setattr(LiveViewer, "begin", watched)
    small = "--seq office --scale 0.1 --frames 0:5 --device cpu -q --checkpoint-every off --save-renders 0"
    assert run.main([*small.split(), "--out", str(tmp_path / "plain")]) == 0
    assert run.main([*small.split(), "--out", str(tmp_path / "seen"), "--viewer-at", "127.0.0.1:0"]) == 0
    assert seen[0].updates == {"frames": 5, "pictures": 5, "maps": 5}
    one, other = load_run(tmp_path / "plain"), load_run(tmp_path / "seen")
    for name, values in one.gaussians.arrays().items():
        np.testing.assert_array_equal(values, getattr(other.gaussians, name))
    np.testing.assert_array_equal(one.poses, other.poses)


@pytest.mark.parametrize("at", ["nonsense:", "192.0.2.1:80"])
def test_an_address_that_cannot_be_is_refused(tmp_path, capsys, at):
    assert run.main(["--seq", "office", "--out", str(tmp_path / "x"), "--viewer-at", at]) == 2
    assert at.partition(":")[0] in capsys.readouterr().err and not (tmp_path / "x").exists()


def test_the_browser_shows_every_third_frame_or_more(viewer):
    with open_browser(500, 400) as tab:
        tab.goto(viewer.url)
        assert _wait(lambda: bool(viewer.server.get_clients()))
        tab.evaluate(
            """() => { window.titles = new Set(); new MutationObserver(() => {
                for (const m of document.body.innerText.matchAll(/Frame (\\d+)/g)) window.titles.add(m[1]);
            }).observe(document.body, {subtree: true, childList: true, characterData: true}); }"""
        )
        for index in range(60):
            viewer.show(*_frame(index), _never)
            tab.wait_for_timeout(100)
        tab.wait_for_timeout(2000)
        assert len(tab.evaluate("() => [...window.titles]")) >= 20
        tab.get_by_role("button", name="Pause").click()
        assert _wait(lambda: not viewer._resumed.is_set())


def _wait(what: Any) -> bool:
    end = time.monotonic() + PATIENCE
    while not what() and time.monotonic() < end:
        time.sleep(0.02)
    return what()
