# SPDX-License-Identifier: Apache-2.0
"""The page's list of objects: a picture and a button each, and a field to look for names."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from ggwarp.viewer.page import Page
from ggwarp.viewer.thumbnails import thumbnails

_ABOVE, _BELOW = 0.0, 1.0  # in a row


class ObjectList:
    """The list."""

    def __init__(self, page: Page) -> None:
        """Add it to what is open; its pictures come as they are drawn."""
        self._page = page
        self._pictures: dict[int, NDArray[np.uint8]] = {}
        self._rows: dict[int, viser.GuiFolderHandle] = {}
        self._shown: Any = None
        gui = page.server.gui
        self._search = gui.add_text("Find", "", hint="Words of an object's name")
        self._search.on_update(lambda _: self._filter())
        self._folder = gui.add_folder("All objects")
        page.changed.append(self.refresh)
        self.refresh()
        page.worker.do_between(self._draw_pictures())

    def refresh(self) -> None:
        """Show the objects that there are by now."""
        wanted = [(r.id, r.name) for r in self._page.session.run.objects]
        if wanted == self._shown:
            return
        self._shown = wanted
        for row in self._rows.values():
            row.remove()
        self._rows = {}
        gui = self._page.server.gui
        for identifier, name in wanted:
            with self._folder, gui.add_folder(None) as row:
                self._rows[identifier] = row
                button = gui.add_button(f"{identifier}  {name}", order=_BELOW)
                button.on_click(self._selecting(identifier))
            self._add_picture(identifier)
        self._filter()

    def _add_picture(self, identifier: int) -> None:
        picture, row = self._pictures.get(identifier), self._rows.get(identifier)
        if picture is not None and row is not None:
            with row:
                self._page.server.gui.add_image(picture, jpeg_quality=80, order=_ABOVE)

    def _selecting(self, identifier: int) -> Any:
        def clicked(event: viser.GuiEvent[Any]) -> None:
            def work() -> None:
                self._page.session.select(identifier)
                self._page.session_changed()

            self._page.ask(event.client, work)

        return clicked

    def _filter(self) -> None:
        words = self._search.value.casefold().split()
        names = {record.id: record.name.casefold() for record in self._page.session.run.objects}
        for identifier, row in self._rows.items():
            row.visible = all(word in names.get(identifier, "") for word in words)

    def _draw_pictures(self) -> Iterator[None]:
        for found in thumbnails(self._page.session.run, device=self._page.device):
            if found is not None:
                self._pictures[found[0]] = found[1]
                self._add_picture(found[0])
            yield
