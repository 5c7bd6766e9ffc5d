# SPDX-License-Identifier: Apache-2.0
"""The page's tab of objects: what is selected, what can be done with it, and all there are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from ggwarp.editing.pictures import before_and_after
from ggwarp.objects.inventory import ObjectRecord
from ggwarp.results.saved_run import RunError
from ggwarp.viewer.page import Page
from ggwarp.viewer.panels.object_list import ObjectList
from ggwarp.viewer.scene import Held

_NOTHING = "*Click an object in the picture, or below; with shift, several.*"
_STEP = 0.05  # metres that a button moves what is held
_FULL = 100.0


class ObjectPanel:
    """The tab."""

    def __init__(self, page: Page) -> None:
        """Add it to the tab that is open."""
        self._page, self._session = page, page.session
        self._held: Held | None = None
        gui = page.server.gui
        self._about = gui.add_markdown(_NOTHING)
        self._progress = gui.add_progress_bar(0.0, visible=False, animated=True)
        self._doing = gui.add_markdown("", visible=False)
        self._buttons("Edit", {"Remove": self._remove, "Move": self._hold, "Paint": self._paint})
        self._fill = gui.add_checkbox("Fill holes", True, hint="Let what was behind a removed object go on")
        self._rgb = gui.add_rgb("Paint with", (200, 40, 40))
        self._name = gui.add_text("Name", "", hint="Of the selected object")
        self._buttons("Objects", {"Rename": self._rename, "Merge": self._merge, "Split": self._split})
        self._buttons("Show", {"Hide": self._hide, "Isolate": self._isolate, "Show all": self._show_all})
        self._buttons("Steps", {"Undo": self._undo, "Redo": self._redo, "Before / after": self._compare})
        self._as_it_was = gui.add_checkbox("Show as it was", False)
        self._moving = gui.add_folder("Moving", visible=False)
        with self._moving:
            gui.add_markdown("Drag the arrows and arcs, or:")
            for axis, name in enumerate("XYZ"):
                self._nudge(axis, name)
            self._buttons("Move", {"Apply": self._apply, "Cancel": self._cancel})
        self._save_button = gui.add_button("Save as a new map", color="orange")
        self._said = gui.add_markdown("")
        self._list = ObjectList(page)
        self._as_it_was.on_update(self._show_as_it_was)
        self._save_button.on_click(lambda event: page.ask(event.client, lambda: self._save(event.client)))
        page.changed.append(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        """Say what is selected and done by now."""
        session = self._session
        records = [session.record(i) for i in session.selected]
        self._about.content = "\n\n".join(map(described, records)) or _NOTHING
        if len(records) == 1:
            self._name.value = records[0].name
        done = "; ".join(session.commands)
        state = "" if session.is_saved else "**not saved:** "
        self._said.content = f"{state}`{done}`" if done else ""
        self._save_button.disabled = session.is_saved

    def _buttons(self, label: str, actions: dict[str, Callable[[], None]]) -> None:
        group = self._page.server.gui.add_button_group(label, tuple(actions))

        @group.on_click
        def _(event: viser.GuiEvent[Any]) -> None:
            def work() -> None:
                actions[event.target.value]()
                self._page.session_changed()

            self._page.ask(event.client, work, alone=True)

    def _nudge(self, axis: int, name: str) -> None:
        offset = _STEP * np.eye(3)[axis]
        signs = {f"- {name}": -offset, f"+ {name}": offset}
        group = self._page.server.gui.add_button_group(f"{100.0 * _STEP:.0f} cm", tuple(signs))

        @group.on_click
        def _(event: viser.GuiEvent[Any]) -> None:
            if self._held is not None:
                self._held.shift(signs[event.target.value])

    def _tell(self, what: str, share: float) -> None:
        self._doing.content = f"{what} ..."
        self._progress.value = _FULL * share

    def _with_progress(self, work: Callable[[], None]) -> None:
        self._tell("working", 0.0)
        self._progress.visible = self._doing.visible = True
        try:
            work()
        finally:
            self._progress.visible = self._doing.visible = False

    def _remove(self) -> None:
        self._put_back()
        self._with_progress(lambda: self._session.remove(fill=self._fill.value, progress=self._tell))

    def _paint(self) -> None:
        self._session.paint(self._rgb.value)

    def _rename(self) -> None:
        self._session.name(self._name.value)

    def _merge(self) -> None:
        self._session.merge()

    def _split(self) -> None:
        try:
            self._session.split()
        except RunError as error:
            if "in one piece" not in str(error):
                raise
            self._session.split(2)

    def _hide(self) -> None:
        self._session.hide(*self._session.selected)

    def _isolate(self) -> None:
        self._session.isolate(*self._session.selected)

    def _show_all(self) -> None:
        self._session.show_all()

    def _undo(self) -> None:
        self._put_back()
        self._session.undo()

    def _redo(self) -> None:
        self._put_back()
        self._session.redo()

    def _hold(self) -> None:
        if len(self._session.selected) != 1:
            raise RunError(f"{len(self._session.selected)} objects are selected; select one to move it")
        self._held = self._page.hold(self._session.selected[0])
        self._moving.visible = True

    def _apply(self) -> None:
        if self._held is None:
            return
        T, fill = self._held.motion(), self._fill.value
        self._with_progress(lambda: self._session.move(T, fill=fill, progress=self._tell))
        self._put_back()

    def _cancel(self) -> None:
        self._put_back()

    def _put_back(self) -> None:
        self._held = None
        self._moving.visible = False
        self._page.release()

    def _compare(self) -> None:
        session = self._session
        picture = before_and_after(session.original, session.run, device=self._page.device)
        if picture is None:
            raise RunError("before / after: no view shows a difference")
        with self._page.server.gui.add_modal("Before and after") as modal:
            self._page.server.gui.add_image(picture)
            self._page.server.gui.add_button("Close").on_click(lambda _: modal.close())

    def _show_as_it_was(self, event: viser.GuiEvent[Any]) -> None:
        self._page.as_it_was = self._as_it_was.value
        self._page.ask(event.client, self._page.draw, key="as it was")

    def _save(self, client: viser.ClientHandle | None) -> None:
        folder = self._session.save()
        self._page.tell(client, "saved", str(folder), color="green")
        self._page.session_changed()


def described(record: ObjectRecord) -> str:
    """Return what is known of an object, as Markdown."""
    name = "".join(f"\\{c}" if c in "\\`*_{}[]<>()#+-.!|~&$" else c for c in record.name)
    size = " x ".join(f"{2.0 * h:.2f}" for h in record.oriented_box.half_sizes)
    return f"**{name}** (object {record.id}): {size} m, {record.count:,} Gaussians"
