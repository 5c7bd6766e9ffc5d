# SPDX-License-Identifier: Apache-2.0
"""The tabs of a finished run's page, put together."""

from __future__ import annotations

from dataclasses import dataclass

import viser

from ggwarp.viewer.page import Page
from ggwarp.viewer.panels.objects import ObjectPanel
from ggwarp.viewer.panels.tools import ToolPanel
from ggwarp.viewer.panels.view import ViewPanel


@dataclass(frozen=True)
class Panels:
    """The tabs of a page; no objects, no tab of them."""

    view: ViewPanel
    tools: ToolPanel
    objects: ObjectPanel | None


def add_panels(page: Page) -> Panels:
    """Add the tabs, and have clicks in the picture select or measure."""
    tabs = page.server.gui.add_tab_group()
    objects = None
    if page.session.run.objects:
        with tabs.add_tab("Objects"):
            objects = ObjectPanel(page)
    with tabs.add_tab("View"):
        view = ViewPanel(page)
    with tabs.add_tab("Tools"):
        tools = ToolPanel(page)

    def clicked(event: viser.SceneClickEvent, *, add: bool) -> None:
        def work() -> None:
            pick = page.session.pick(event.ray_origin, event.ray_direction)
            if tools.take(pick):
                return
            page.session.select(*([] if pick is None or pick.object_id == 0 else [pick.object_id]), add=add)
            page.session_changed()

        page.ask(event.client, work)

    page.server.scene.on_click()(lambda event: clicked(event, add=False))
    page.server.scene.on_click(modifier="shift")(lambda event: clicked(event, add=True))
    return Panels(view, tools, objects)
