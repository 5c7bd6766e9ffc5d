# SPDX-License-Identifier: Apache-2.0
"""The page of a finished run: what its panels share, and what they show together."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from ggwarp.editing.map_view import MapView
from ggwarp.geometry import se3
from ggwarp.map.gaussians import Gaussians
from ggwarp.results.saved_run import RunError
from ggwarp.results.scene_view import SceneView
from ggwarp.types import Float64
from ggwarp.viewer import colours, scene
from ggwarp.viewer.edit_session import EditSession
from ggwarp.viewer.history import History
from ggwarp.viewer.worker import Worker

log = logging.getLogger(__name__)

_SELECTION = "/selection"
_SHORT = 6.0  # seconds that a notice stays


class Page:
    """What is on a page, and the one thread that changes it.

    Attributes:
        server: viser's.
        session: the run and its edits.
        history: the run's course.
        mode: of the splats' colours, see :mod:`ggwarp.viewer.colours`.
        as_it_was: whether the map is shown without the edits.
        worker: does all that takes time.
        changed: called after the session has changed: another map, selection, or what is hidden.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: EditSession,
        history: History,
        first: SceneView,
        *,
        device: Any = "cpu",
    ) -> None:
        """Set the scene up, and show the map."""
        self.server, self.session, self.history = server, session, history
        self.device = device
        self.mode, self.as_it_was = colours.COLOUR, False
        self.worker = Worker()
        self.changed: list[Callable[[], None]] = []
        self._eye = np.asarray(first.start[:3, 3])
        self._working = False
        self._drawn: tuple[Any, ...] = ()
        self._held: scene.Held | None = None
        self._rendered: tuple[Gaussians, MapView] | None = None
        scene.begin_with(server, first, session.run.camera)
        server.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, control_width="large"
        )
        scene.add_trajectories(server.scene, session.run.poses, history.live, history.loops)
        self.draw()

    def ask(
        self,
        client: viser.ClientHandle | None,
        work: Callable[[], None],
        *,
        key: str = "",
        alone: bool = False,
    ) -> None:
        """Have ``work`` done for ``client``, who is told what goes wrong.

        Args:
            key: see :meth:`Worker.do`.
            alone: it takes long, and is refused while another that does is being done or waits.
        """
        if alone and self._working:
            self.tell(client, "busy", "the edit before is still being made")
            return
        self._working = self._working or alone

        def whole() -> None:
            try:
                work()
            finally:
                self._working = self._working and not alone

        def failed(error: Exception) -> None:
            if not isinstance(error, (RunError, OSError)):
                log.error("the viewer failed", exc_info=error)
            self.tell(client, "not done", str(error) or type(error).__name__, color="red")

        self.worker.do(whole, failed, key=key)

    def tell(self, client: viser.ClientHandle | None, title: str, text: str, **options: Any) -> None:
        """Show a notice to ``client``; None: to all."""
        for one in self.server.get_clients().values() if client is None else [client]:
            one.add_notification(title, text, auto_close_seconds=_SHORT, **options)

    def session_changed(self) -> None:
        """Draw what the session has become, and tell the panels."""
        self.draw()
        for listener in self.changed:
            listener()

    def looked_from(self, eye: Float64) -> None:
        """Colour the map's depth anew, as seen from ``eye`` [3]."""
        self._eye = eye
        if self.mode == colours.DEPTH:
            self.draw()

    def draw(self) -> None:
        """Show the map and the selection, where they differ from what is shown."""
        session = self.session
        run = session.original if self.as_it_was else session.run
        visible = np.ones(len(run.gaussians), bool) if self.as_it_was else session.visible
        eye = tuple(self._eye) if self.mode == colours.DEPTH else ()
        key = (id(run), self.mode, session.selected, session.hidden, self.as_it_was, eye)
        if key == self._drawn:
            return
        self._drawn = key
        shades = colours.splat_colours(run.gaussians, self.mode, eye=self._eye, classifier=run.classifier)
        ids = run.gaussians.object_ids
        if ids is not None and session.selected and not self.as_it_was:
            shades = colours.tinted(shades, np.isin(ids, session.selected))
        scene.show_splats(self.server.scene, scene.MAP, run.gaussians.take(visible), shades[visible])
        self._draw_boxes()

    def hold(self, object_id: int) -> scene.Held:
        """Show an object by itself, on a gizmo that moves it; :meth:`release` ends that."""
        self.release()
        run = self.session.run
        grip, chosen = self.session.grip(object_id)
        visible = self.session.visible & ~chosen
        shades = colours.splat_colours(run.gaussians, self.mode, eye=self._eye, classifier=run.classifier)
        scene.show_splats(self.server.scene, scene.MAP, run.gaussians.take(visible), shades[visible])
        self._held = scene.hold(
            self.server.scene,
            run.gaussians.take(chosen),
            shades[chosen],
            grip,
            self.session.record(object_id),
        )
        return self._held

    def release(self) -> None:
        """Put what is held back where it is in the map."""
        if self._held is not None:
            self._held.remove()
            self._held, self._drawn = None, ()
            self.draw()

    def view(self) -> MapView:
        """Return a renderer of the map as it is shown, for the run's camera."""
        run = self.session.original if self.as_it_was else self.session.run
        gaussians = run.gaussians if self.as_it_was else self.session.shown()
        if self._rendered is None or self._rendered[0] is not gaussians:
            self._rendered = gaussians, MapView(gaussians, run.camera, device=self.device)
        return self._rendered[1]

    def _draw_boxes(self) -> None:
        self.server.scene.remove_by_name(_SELECTION)
        if self.as_it_was:
            return
        for identifier in self.session.selected:
            record = self.session.record(identifier)
            scene.add_box(self.server.scene, f"{_SELECTION}/{identifier}", record.oriented_box)
            above = np.array(record.centre)
            self.server.scene.add_label(f"{_SELECTION}/{identifier}/name", record.name, position=above)


def pose_of(camera: viser.CameraHandle) -> Float64:
    """Return the camera-to-world pose [4, 4] of a client's camera."""
    T_wc = np.eye(4)
    T_wc[:3, :3] = se3.matrix_from_quat(camera.wxyz)
    T_wc[:3, 3] = camera.position
    return T_wc
