# SPDX-License-Identifier: Apache-2.0
"""The page in a real browser: what it draws, what a click means, and edits by clicks alone."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from browser import PATIENCE as BROWSER_PATIENCE
from browser import find_browser, open_browser
from ggwarp import run
from ggwarp.datasets import open_dataset
from ggwarp.editing.device import ready_device
from ggwarp.editing.map_view import MapView
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.results.saved_run import load_run
from ggwarp.viewer import scene
from ggwarp.viewer.__main__ import main as view_command
from ggwarp.viewer.build import open_page
from ggwarp.viewer.page import Page
from ggwarp.viewer.panels.tabs import Panels
from ggwarp.viewer.server import stop_server

WIDTH, HEIGHT = 860, 420
FREE = (slice(150, HEIGHT - 10), slice(10, 450))
"""Rows and columns of the window with nothing but the scene in them."""
ROWS = (0, 1, 2)
CLICKS = 20
PATIENCE = 240.0  # seconds: a browser that draws on a busy CPU takes long


@dataclass
class Opened:
    page: Page
    panels: Panels
    tab: Any
    errors: list[str]

    def wait(self, what: Callable[[], bool]) -> bool:
        """Let the browser work until ``what``; False: it took too long."""
        end = time.monotonic() + PATIENCE
        while not what():
            if time.monotonic() > end:
                return False
            self.tab.wait_for_timeout(50)
        return True

    def press(self, name: str) -> None:
        self.tab.get_by_role("button", name=name, exact=True).click()

    def field(self, label: str) -> Any:
        return self.tab.get_by_text(label, exact=True).locator("xpath=ancestor::div[.//input][1]//input")

    def settle(self) -> None:
        self.tab.wait_for_timeout(100)
        assert self.page.worker.wait(PATIENCE)

    def look_from(self, T_wc: np.ndarray) -> None:
        """Turn the browser's camera, and wait until it says that it has."""
        client = next(iter(self.page.server.get_clients().values()))
        fov = scene.field_of_view(self.page.session.run.camera)
        scene.look_from(client.camera, T_wc, fov)
        stamp = client.camera.update_timestamp
        self.wait(lambda: client.camera.update_timestamp != stamp)
        self.tab.wait_for_timeout(500)


@pytest.fixture(scope="module")
def office(tmp_path_factory) -> Path:
    find_browser()
    folder = tmp_path_factory.mktemp("office") / "run"
    arguments = (
        "--seq office --frames 0:12:4 --scale 0.2 --device cpu -q --checkpoint-every off --save-renders 0"
    )
    assert run.main([*arguments.split(), "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def opened(office: Path) -> Iterator[Opened]:
    page, panels, url = open_page(load_run(office), port=0, device=ready_device("cpu"))
    errors: list[str] = []
    try:
        with open_browser(WIDTH, HEIGHT) as tab:
            tab.on("pageerror", lambda error: errors.append(str(error)))
            tab.goto(url)
            one = Opened(page, panels, tab, errors)
            assert one.wait(lambda: bool(page.server.get_clients()))
            yield one
    finally:
        stop_server(page.server)


def browser_camera(fov: float) -> Camera:
    focal = 0.5 * HEIGHT / np.tan(0.5 * fov)
    return Camera(WIDTH, HEIGHT, focal, focal, 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1))


def test_the_splats_are_drawn_as_our_renderer_draws_them(opened):
    """At the start pose, where the page opens by itself."""
    run_, tab = opened.page.session.run, opened.tab
    tab.get_by_role("tab", name="View").click()
    tab.get_by_label("Trajectory", exact=True).click()
    assert opened.page.worker.wait(PATIENCE)
    camera = browser_camera(scene.field_of_view(run_.camera))
    ours = MapView(run_.gaussians, camera).render(run_.scene_view().start).rgb
    assert ours[FREE].std() > 0.1
    assert quality_of(tab, ours) >= 25.0
    assert not opened.errors


def quality_of(tab: Any, ours: np.ndarray) -> float:
    """Return the PSNR of what the window shows, decibels, once it is good: browsers sort in their time."""
    quality = 0.0
    end = time.monotonic() + PATIENCE
    while quality < 25.0 and time.monotonic() < end:
        tab.wait_for_timeout(500)
        shot = cv2.imdecode(np.frombuffer(tab.screenshot(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1] / 255.0
        quality = float(-10.0 * np.log10(np.mean((shot[FREE] - ours[FREE]) ** 2)))
    print(f"PSNR {quality:.1f} dB")
    return quality


def test_a_scene_is_one_file_that_needs_no_network(opened, office, tmp_path):
    path = tmp_path / "scene.html"
    assert view_command([str(office), "--save", str(path)]) == 0
    run_ = opened.page.session.run
    ours = MapView(run_.gaussians, browser_camera(scene.field_of_view(run_.camera))).render(
        run_.scene_view().start
    )
    asked: list[str] = []
    tab = opened.tab.context.browser.new_context(
        viewport={"width": WIDTH, "height": HEIGHT}, offline=True
    ).new_page()
    tab.set_default_timeout(BROWSER_PATIENCE)
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(path.as_uri())
    quality = quality_of(tab, ours.rgb)
    tab.close()
    assert quality >= 25.0  # a line is drawn over it
    assert [url for url in asked if not url.startswith(("data:", "blob:"))] == [path.as_uri()]


def test_a_click_selects_what_the_true_masks_have_there(opened, rng):
    session = opened.page.session
    truth = open_dataset("office", data_root=Path("absent"))
    opened.tab.get_by_role("tab", name="Objects").click()
    camera = browser_camera(scene.field_of_view(session.run.camera))
    trials = right = 0
    wrong: list[tuple[int, int]] = []
    for row in ROWS:
        opened.look_from(session.run.poses[row])
        for u, v, identifier in _targets(truth, opened.page.history.indices[row], camera, rng)[
            : -(-CLICKS // len(ROWS))
        ]:
            session.select()
            opened.tab.mouse.click(u, v)
            opened.wait(lambda: bool(session.selected))
            trials += 1
            right += session.selected == (identifier,)
            if session.selected != (identifier,):
                wrong.append((identifier, *session.selected))
    print(f"{right} of {trials} clicks, wrong: {wrong}")
    assert trials >= CLICKS and right >= 0.9 * trials, wrong


def _targets(
    truth: Any, index: int, camera: Camera, rng: np.random.Generator
) -> list[tuple[float, float, int]]:
    """Return a pixel of the window in each object that frame ``index`` shows there, and its true id."""
    mask, native = truth[index].mask, truth.camera
    found = []
    for identifier in np.unique(mask[mask > 0]).tolist():
        inside = cv2.erode((mask == identifier).astype(np.uint8), np.ones((9, 9), np.uint8))
        rows, columns = np.nonzero(inside)
        u = (columns - native.cx) / native.fx * camera.fx + camera.cx
        v = (rows - native.cy) / native.fy * camera.fy + camera.cy
        free = (u > FREE[1].start) & (u < FREE[1].stop) & (v > FREE[0].start) & (v < FREE[0].stop)
        if free.any():
            k = rng.choice(np.nonzero(free)[0])
            found.append((float(u[k]), float(v[k]), identifier))
    return [found[k] for k in rng.permutation(len(found))]


def test_an_object_is_removed_and_brought_back_and_saved_by_clicks(opened, office):
    session, tab = opened.page.session, opened.tab
    vase = session.run.find("vase")
    before = len(session.run.gaussians)
    opened.field("Find").fill("vase")
    opened.press(f"{vase.id} vase")
    assert opened.wait(lambda: session.selected == (vase.id,))
    tab.get_by_text(f"(object {vase.id})").wait_for()
    opened.press("Remove")
    assert opened.wait(lambda: bool(session.commands))
    opened.settle()
    assert vase.id not in [record.id for record in session.run.objects]
    opened.press("Undo")
    opened.wait(lambda: not session.commands)
    assert len(session.run.gaussians) == before and session.record(vase.id)
    opened.press("Redo")
    assert opened.wait(lambda: session.commands == [f"remove {vase.id}"])
    opened.press("Save as a new map")
    assert opened.wait(lambda: session.is_saved)
    saved = load_run(office.with_name("run-edit1"))
    assert vase.id not in [record.id for record in saved.objects] and saved.edits[0]["edit"] == "remove"
    assert len(load_run(office).gaussians) == before
    opened.press("Undo")
    assert opened.wait(lambda: not session.commands)
    opened.field("Find").fill("")


def test_an_object_is_moved_on_its_gizmo(opened):
    session = opened.page.session
    table = session.run.find("side table")
    session.select(table.id)
    opened.page.worker.do(opened.page.session_changed, lambda error: None)
    opened.settle()
    opened.press("Move")
    assert opened.wait(lambda: opened.page.server.scene.get_handle_by_name("/held") is not None)
    opened.press("+ X")
    opened.press("+ X")
    opened.tab.get_by_label("Fill holes").click()
    opened.press("Apply")
    assert opened.wait(lambda: bool(session.commands))
    opened.settle()
    shift = np.array(session.record(table.id).centre) - table.centre
    np.testing.assert_allclose(shift, [0.1, 0.0, 0.0], atol=0.01)
    assert opened.page.server.scene.get_handle_by_name("/held") is None
    opened.press("Undo")
    assert opened.wait(lambda: not session.commands)


def test_two_clicks_measure(opened):
    session, tools = opened.page.session, opened.panels.tools
    T_wc = session.run.poses[0]
    opened.look_from(T_wc)
    opened.tab.get_by_role("tab", name="Tools").click()
    opened.tab.get_by_label("Clicks measure").click()
    camera = browser_camera(scene.field_of_view(session.run.camera))
    spots = [(150.0, 330.0), (420.0, 240.0)]
    depth = open_dataset("office", data_root=Path("absent"))[0].depth
    native = open_dataset("office", data_root=Path("absent")).camera
    points = []
    for u, v in spots:
        opened.tab.mouse.click(u, v)
        opened.settle()
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        z = depth[round(y * native.fy + native.cy), round(x * native.fx + native.cx)]
        points.append(se3.transform_points(T_wc, np.array([[x * z, y * z, z]]))[0])
    assert opened.wait(lambda: tools.measured is not None)
    true = float(np.linalg.norm(points[0] - points[1]))
    assert tools.measured == pytest.approx(true, abs=0.05)
    opened.tab.get_by_label("Clicks measure").click()
