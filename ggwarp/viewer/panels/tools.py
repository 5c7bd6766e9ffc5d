# SPDX-License-Identifier: Apache-2.0
"""The page's tab of tools: measuring, pictures, a camera path as a video."""

from __future__ import annotations

import itertools
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import viser

from ggwarp.editing.map_view import MapView
from ggwarp.editing.pictures import as_bytes
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.results.saved_run import RunError
from ggwarp.types import Float64
from ggwarp.viewer.page import Page, pose_of
from ggwarp.viewer.picking import Pick

_MEASURE = "/measure"
_LENS = 12.0  # seconds that a screenshot may take
_RATE = 30  # pictures a second of a video
_LONGEST = 120.0  # seconds
_WIDTH = 960


class ToolPanel:
    """The tab.

    Attributes:
        measured: metres between the last two points; None: none yet.
    """

    def __init__(self, page: Page) -> None:
        """Add it to the tab that is open."""
        self._page = page
        self.measured: float | None = None
        self._points: list[Float64] = []
        self._views: list[Float64] = []
        self._lens = 1.0
        gui = page.server.gui
        with gui.add_folder("Measure"):
            self._measuring = gui.add_checkbox("Clicks measure", False, hint="Click two points of a surface")
            self._length = gui.add_markdown("")
        with gui.add_folder("Picture"):
            gui.add_button("Screenshot").on_click(self._screenshot)
        with gui.add_folder("Camera path"):
            group = gui.add_button_group("Views", ("Add this view", "Forget them"))
            group.on_click(self._edit_path)
            self._path = gui.add_markdown("")
            self._seconds = gui.add_slider("Seconds a view", min=0.5, max=5.0, step=0.5, initial_value=2.0)
            gui.add_button("Make the video").on_click(
                lambda event: page.ask(event.client, lambda: self._film(event.client), alone=True)
            )

    def take(self, pick: Pick | None) -> bool:
        """Use a click to measure, and return whether it was one."""
        if not self._measuring.value:
            return False
        if pick is None:
            raise RunError("measure: there is no surface")
        if len(self._points) == 2:
            self._points = []
        self._points.append(pick.point)
        scene = self._page.server.scene
        scene.add_point_cloud(f"{_MEASURE}/points", np.array(self._points), (255, 255, 0), point_size=0.015)
        if len(self._points) == 2:
            one, other = self._points
            self.measured = float(np.linalg.norm(one - other))
            self._length.content = f"**{self.measured:.3f} m**"
            scene.add_line_segments(
                f"{_MEASURE}/line",
                np.array([[one, other]]),
                (255, 255, 0),
                thickness=2.5,
                thickness_units="screen",
            )
            scene.add_label(f"{_MEASURE}/length", f"{self.measured:.3f} m", position=0.5 * (one + other))
        else:
            for name in ("line", "length"):
                scene.remove_by_name(f"{_MEASURE}/{name}")
        return True

    def _screenshot(self, event: viser.GuiEvent[Any]) -> None:
        client = event.client
        if client is None:
            return

        def work() -> None:
            camera = client.camera
            picture = client.get_render(
                camera.image_height, camera.image_width, transport_format="png", timeout=_LENS
            )
            data = cv2.imencode(".png", picture[..., [2, 1, 0, 3]])[1].tobytes()
            client.send_file_download("ggwarp.png", data, save_immediately=True)

        self._page.ask(client, work)

    def _edit_path(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None and event.target.value == "Add this view":
            self._views.append(pose_of(event.client.camera))
            self._lens = float(event.client.camera.fov)
        else:
            self._views = []
        self._path.content = f"{len(self._views)} views"

    def _film(self, client: viser.ClientHandle | None) -> None:
        if len(self._views) < 2:
            raise RunError("video: add two views or more")
        steps = round(_RATE * min(self._seconds.value, _LONGEST / len(self._views)))
        height = round(_WIDTH * 9 / 16)
        focal = 0.5 * height / np.tan(0.5 * self._lens)
        camera = Camera(_WIDTH, height, focal, focal, 0.5 * (_WIDTH - 1), 0.5 * (height - 1))
        view = MapView(self._page.session.shown(), camera, device=self._page.device)
        with tempfile.TemporaryDirectory(prefix="ggwarp-") as folder:
            path = Path(folder) / "path.mp4"
            writer = cv2.VideoWriter(
                str(path), cv2.VideoWriter.fourcc(*"mp4v"), _RATE, (camera.width, camera.height)
            )
            for T_wc in between(self._views, steps):
                writer.write(as_bytes(view.render(T_wc).rgb)[..., ::-1])
            writer.release()
            if client is not None:
                client.send_file_download("path.mp4", path.read_bytes(), save_immediately=True)


def between(poses: list[Float64], steps: int) -> list[Float64]:
    """Return a path through ``poses`` [4, 4], ``steps`` a pair, that slows down at each, and the last one."""
    path: list[Float64] = []
    for one, other in itertools.pairwise(poses):
        turn = se3.so3_log(one[:3, :3].T @ other[:3, :3])
        for share in np.arange(steps) / steps:
            smooth = share * share * (3.0 - 2.0 * share)
            T_wc = np.eye(4)
            T_wc[:3, :3] = one[:3, :3] @ se3.so3_exp(smooth * turn)
            T_wc[:3, 3] = (1.0 - smooth) * one[:3, 3] + smooth * other[:3, 3]
            path.append(T_wc)
    return [*path, poses[-1]]
