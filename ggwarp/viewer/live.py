# SPDX-License-Identifier: Apache-2.0
"""The page during a run: the map grows, the camera goes on, and the run can be paused, stepped and saved."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ggwarp.console import Display
from ggwarp.editing.pictures import as_bytes
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.renderer import Renderer
from ggwarp.types import Float64, Frame, StepReport, Verdict
from ggwarp.viewer import colours, scene
from ggwarp.viewer.panels.view import stacked
from ggwarp.viewer.server import start_server, stop_server
from ggwarp.viewer.watching import Watched

_PICTURES, _MAP = 0.025, 0.025
"""Shares of the run's time that pictures and the map may take, while somebody looks."""
_LINES = 6
_LOOK = 0.05  # seconds after which one who waits looks whether to go on
_FOLLOW_BEHIND, _FOLLOW_ABOVE = 1.5, 0.6  # metres of the page's first view from the first camera
_MARKS = {Verdict.CONVERGED: "", Verdict.POOR: " (weak)", Verdict.LOST: " **lost**"}


class Budget:
    """Keeps what is done now and then within a share of the time."""

    def __init__(self, share: float, clock: Callable[[], float] = time.perf_counter) -> None:
        self._share, self._clock = share, clock
        self._began: float | None = None
        self._spent = 0.0

    @property
    def is_left(self) -> bool:
        """Whether less than the share of the time since the first question was spent."""
        now = self._clock()
        self._began = now if self._began is None else self._began
        return self._spent <= self._share * (now - self._began)

    @contextmanager
    def spending(self) -> Iterator[None]:
        """Count the time of what is done inside."""
        started = self._clock()
        try:
            yield
        finally:
            self._spent += self._clock() - started


class LiveViewer:
    """Shows a run in the browser.

    Without anybody who looks, a frame costs the position that is noted down; with somebody, pictures and map
    are sent as often as their shares of the run's time allow. Nothing that the run computes is changed by it.

    Attributes:
        url: the page's address, token included.
        updates: how many times each part was sent: "frames", "pictures", "maps".
    """

    def __init__(self, host: str, port: int) -> None:
        """Start the page.

        Raises:
            RunError: ``host`` cannot be listened on.
        """
        self.server, self.url = start_server(host, port)
        self.updates = {"frames": 0, "pictures": 0, "maps": 0}
        self._system: Watched | None = None
        self._renderer: Renderer | None = None
        self._rendered_map: GaussianMap | None = None
        self._folder = Path()
        self._path: list[Float64] = []
        self._said: deque[str] = deque(maxlen=_LINES)
        self._resumed, self._steps, self._saving = (
            threading.Event(),
            threading.Semaphore(0),
            threading.Event(),
        )
        self._resumed.set()
        self._budgets = {"pictures": Budget(_PICTURES), "maps": Budget(_MAP)}
        self._add_panel()

    def _add_panel(self) -> None:
        gui = self.server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="large")
        self._stage = gui.add_markdown("*starting*")
        self._pace = gui.add_markdown("")
        self._run_group = gui.add_button_group("Run", ("Pause", "Step", "Go on", "Save now"))
        self._run_group.on_click(lambda event: self._press(event.target.value))
        self._follow = gui.add_checkbox("Follow the camera", False)
        self._title = gui.add_markdown("")
        self._pair = gui.add_image(np.zeros((2, 2, 3), np.uint8), jpeg_quality=80)
        self._log = gui.add_markdown("")

    def begin(self, system: Watched, folder: Path) -> None:
        """Watch ``system``; what is saved on the way goes beside ``folder``."""
        self._system, self._folder = system, folder

    def show(self, frame: Frame, step: StepReport, stopped: Callable[[], bool]) -> float:
        """Show a frame that was processed; return the seconds that the user held the run up."""
        system = self._system
        assert system is not None, "begin() comes first"
        if not self._path:
            self._look_at_the_start(step.T_wc, system)
        self._path.append(step.T_wc[:3, 3])
        if self.server.get_clients():
            self._send(system, frame, step)
        if self._saving.is_set():
            self._saving.clear()
            self._save(system, step)
        return self._wait(stopped)

    def say(self, line: str) -> None:
        """Show a line of the command's."""
        self._said.append(line)
        self._log.content = "\n\n".join(f"`{said.replace('`', chr(39))}`" for said in self._said)

    def enter_stage(self, name: str, total: int | None) -> None:
        """Show what the command is at."""
        self._stage.content = f"**{name}**" + ("" if total is None else f", {total}")

    def tell_pace(self, status: str) -> None:
        """Show how fast it goes."""
        if status:
            self._pace.content = status

    def close(self) -> None:
        """End the page."""
        self._resumed.set()
        stop_server(self.server)

    def _send(self, system: Watched, frame: Frame, step: StepReport) -> None:
        self.updates["frames"] += 1
        why = f" {step.reason}" if step.reason else ""
        title = f"Frame {step.index}{_MARKS[step.verdict]}{why}: render above, frame below"
        if (shown := system.map.count) < step.gaussians:
            title += f". Shown are {shown} of {step.gaussians} Gaussians: the others are out of memory"
        self._title.content = title
        if (budget := self._budgets["pictures"]).is_left:
            with budget.spending():
                self._send_pictures(system, frame, step)
        if (budget := self._budgets["maps"]).is_left:
            with budget.spending():
                self._send_map(system)

    def _send_pictures(self, system: Watched, frame: Frame, step: StepReport) -> None:
        self.updates["pictures"] += 1
        with system.mapping_scope:
            rgb = self._rendering(system, step.T_wc)
        self._pair.image = stacked(rgb, frame.rgb)
        small = np.ascontiguousarray(frame.rgb[::2, ::2])
        scene.add_frustum(self.server.scene, "/camera", step.T_wc, system.camera, small, size=0.2)
        scene.add_path(self.server.scene, scene.LIVE, np.array(self._path), (120, 160, 255))
        if self._follow.value:
            for client in self.server.get_clients().values():
                scene.look_from(client.camera, step.T_wc, scene.field_of_view(system.camera))

    def _send_map(self, system: Watched) -> None:
        self.updates["maps"] += 1
        with system.mapping_scope:
            gaussians = system.map.to_host()
        shades = colours.splat_colours(gaussians, colours.COLOUR, eye=np.zeros(3))
        scene.show_splats(self.server.scene, scene.MAP, gaussians, shades)

    def _rendering(self, system: Watched, T_wc: Float64) -> Any:
        """Render by arrays of our own: the run's are left as they are."""
        if self._renderer is None or self._rendered_map is not system.map:
            self._renderer = Renderer(system.map, system.camera, identity=False)
            self._rendered_map = system.map
        self._renderer.render(T_wc)
        return as_bytes(self._renderer.picture().rgb)

    def _look_at_the_start(self, T_wc: Float64, system: Watched) -> None:
        """Let pages begin a little behind and above the first camera."""
        up = -T_wc[:3, 1]
        first = self.server.initial_camera
        self.server.scene.set_up_direction(up)
        first.up, first.fov = up, scene.field_of_view(system.camera)
        first.position = T_wc[:3, 3] - _FOLLOW_BEHIND * T_wc[:3, 2] + _FOLLOW_ABOVE * up
        first.look_at = T_wc[:3, 3] + T_wc[:3, 2]
        for client in self.server.get_clients().values():
            client.camera.up_direction = up
            client.camera.position, client.camera.look_at = first.position, first.look_at

    def _press(self, button: str) -> None:
        if button == "Save now":
            self._saving.set()
            self._steps.release()  # one who is paused looks
        elif button == "Pause":
            self._resumed.clear()
        elif button == "Step":
            self._resumed.clear()
            self._steps.release()
        else:
            self._resumed.set()

    def _wait(self, stopped: Callable[[], bool]) -> float:
        if self._resumed.is_set():
            return 0.0
        started = time.perf_counter()
        self._stage.content = "**paused**"
        while not (self._resumed.is_set() or stopped() or self._steps.acquire(timeout=_LOOK)):
            pass
        self._stage.content = "**frames**"
        return time.perf_counter() - started

    def _save(self, system: Watched, step: StepReport) -> None:
        target = self._folder.with_name(f"{self._folder.name}-frame{step.index:06d}")
        try:
            with system.mapping_scope:
                system.save(target)
        except OSError as error:
            self.say(f"not saved: {error.filename}: {error.strerror}")
            return
        self.say(f"saved in {target}")


class ShownDisplay:
    """A display that tells a viewer, too, how the run goes."""

    def __init__(self, display: Display, viewer: LiveViewer) -> None:
        self._display, self._viewer = display, viewer

    @property
    def warnings(self) -> list[str]:
        """What was warned of."""
        return self._display.warnings

    def note(self, line: str) -> None:
        """Say one thing on the way."""
        self._viewer.say(line)
        self._display.note(line)

    def warn(self, line: str) -> None:
        """Say that something is amiss."""
        self._viewer.say(f"warning: {line}")
        self._display.warn(line)

    def stage(self, name: str, total: int | None = None) -> None:
        """Begin a stage of ``total`` steps."""
        self._viewer.enter_stage(name, total)
        self._display.stage(name, total)

    def advance(self, status: str = "") -> None:
        """Count a step of the stage and show how it stands."""
        self._viewer.tell_pace(status)
        self._display.advance(status)

    def close(self) -> None:
        """End the progress display."""
        self._display.close()

    def results(self, metrics: dict[str, Any], groups: dict[str, list[str]]) -> None:
        """Show the figures."""
        self._display.results(metrics, groups)

    def ask(self, question: str, stopped: Callable[[], bool]) -> str:
        """Return what the user answers on the terminal."""
        return self._display.ask(question, stopped)

    def conclude(self, line: str) -> None:
        """Say the last thing."""
        self._viewer.say(line)
        self._display.conclude(line)
