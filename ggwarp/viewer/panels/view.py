# SPDX-License-Identifier: Apache-2.0
"""The page's tab of views: what the map is coloured by, what is drawn beside it, and the trajectory."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from ggwarp.editing.pictures import as_bytes
from ggwarp.viewer import scene
from ggwarp.viewer.colours import modes
from ggwarp.viewer.history import RecordedPictures
from ggwarp.viewer.page import Page

_CURRENT = "/current"
_CURRENT_COLOUR = (40, 200, 90)
_MOST_FRUSTUMS = 60
_PICTURE = 160  # pixels that a keyframe's picture is wide
_GAP = 4


class ViewPanel:
    """The tab."""

    def __init__(self, page: Page) -> None:
        """Add it to the tab that is open; keyframes' pictures come as they are drawn."""
        self._page = page
        run, history, gui = page.session.run, page.history, page.server.gui
        self._recorded = RecordedPictures(run.folder)
        self._mode = gui.add_dropdown("Colours", tuple(modes(run.gaussians, run.classifier)))
        self._mode.on_update(self._recolour)
        self._check("Trajectory", scene.FINAL, True)
        if len(history.live):
            self._check("As tracked live", scene.LIVE, False)
        if history.loops:
            self._check("Loops", scene.LOOPS, True)
        if history.keyframes:
            self._keyframes = self._check("Keyframes", scene.KEYFRAMES, False)
            page.server.scene.add_frame(scene.KEYFRAMES, show_axes=False, visible=False)
            page.worker.do_between(self._draw_keyframes())
        with gui.add_folder("Along the trajectory"):
            last = max(1, len(run.poses) - 1)
            self._slider = gui.add_slider("Pose", min=0, max=last, step=1, initial_value=0)
            self._slider.on_update(lambda e: page.ask(e.client, self._show_pose, key="pose"))
            gui.add_button("Look from there").on_click(self._go)
            self._title = gui.add_markdown("")
            self._pair = gui.add_image(np.zeros((2, 2, 3), np.uint8), jpeg_quality=90)
        page.changed.append(lambda: page.ask(None, self._show_pose, key="pose"))
        page.ask(None, self._show_pose, key="pose")

    def _check(self, label: str, node: str, value: bool) -> viser.GuiCheckboxHandle:
        box = self._page.server.gui.add_checkbox(label, value)

        @box.on_update
        def _(_: Any) -> None:
            if (handle := self._page.server.scene.get_handle_by_name(node)) is not None:
                handle.visible = box.value

        return box

    def _recolour(self, event: viser.GuiEvent[Any]) -> None:
        def work() -> None:
            self._page.mode = self._mode.value
            if event.client is not None:
                self._page.looked_from(np.array(event.client.camera.position))
            self._page.draw()

        self._page.ask(event.client, work, key="mode")

    @property
    def _row(self) -> int:
        return min(int(self._slider.value), len(self._page.session.run.poses) - 1)

    def _show_pose(self) -> None:
        """Draw the slider's camera, and what the map and the recording show from there."""
        run, row = self._page.session.run, self._row
        T_wc, index = run.poses[row], self._page.history.indices[row]
        render = as_bytes(self._page.view().render(T_wc).rgb)
        frame = self._recorded.picture(index)
        if frame is not None and frame.shape != render.shape:
            small = cv2.resize(frame, render.shape[1::-1], interpolation=cv2.INTER_AREA)
            frame = np.asarray(small, np.uint8)
        frustum = scene.add_frustum(
            self._page.server.scene, _CURRENT, T_wc, run.camera, size=0.15, colour=_CURRENT_COLOUR
        )
        frustum.visible = row > 0  # the page begins at the first
        beside = "" if frame is None else f", beside the frame: PSNR {psnr(render, frame):.1f} dB"
        self._title.content = f"Frame {index}: render{beside}"
        self._pair.image = render if frame is None else stacked(render, frame)

    def _go(self, event: viser.GuiEvent[Any]) -> None:
        run = self._page.session.run
        if event.client is not None:
            scene.look_from(event.client.camera, run.poses[self._row], scene.field_of_view(run.camera))

    def _draw_keyframes(self) -> Iterator[None]:
        run, keyframes = self._page.session.run, self._page.history.keyframes
        for row in keyframes[:: -(-len(keyframes) // _MOST_FRUSTUMS)]:
            picture = as_bytes(self._page.view().render(run.poses[row]).rgb)
            size = _PICTURE, max(1, round(_PICTURE * run.camera.height / run.camera.width))
            small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
            name = f"{scene.KEYFRAMES}/{self._page.history.indices[row]}"
            frustum = scene.add_frustum(self._page.server.scene, name, run.poses[row], run.camera, small)
            frustum.on_click(self._jump(row))
            yield

    def _jump(self, row: int) -> Any:
        def clicked(_: Any) -> None:
            self._slider.value = row

        return clicked


def stacked(above: NDArray[np.uint8], below: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return two pictures of one size, one above the other."""
    return np.concatenate([above, np.full((_GAP, *above.shape[1:]), 255, np.uint8), below])


def psnr(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    """Return the peak signal-to-noise ratio of two pictures, decibels."""
    error = np.mean((one.astype(np.float64) - other) ** 2) / 255.0**2
    return float(-10.0 * np.log10(max(error, 1e-12)))
