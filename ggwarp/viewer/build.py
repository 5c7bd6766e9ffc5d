# SPDX-License-Identifier: Apache-2.0
"""The page of a finished run, put together."""

from __future__ import annotations

from typing import Any

from ggwarp.geometry.upright import Up
from ggwarp.results.saved_run import SavedRun
from ggwarp.viewer.edit_session import EditSession
from ggwarp.viewer.history import read_history
from ggwarp.viewer.page import Page
from ggwarp.viewer.panels.tabs import Panels, add_panels
from ggwarp.viewer.server import LOCAL, PORT, start_server


def open_page(
    run: SavedRun, host: str = LOCAL, port: int = PORT, *, device: Any = "cpu", up: Up | None = None
) -> tuple[Page, Panels, str]:
    """Start the page of ``run``; return it, its tabs and its address.

    Args:
        up: which way is up; None: as the run's folder says, or estimated.
        up: which way is up; None: as the run's folder says, or estimated.
        device: what is rendered on; its kernels are loaded (:mod:`ggwarp.editing.device`).

    Raises:
        RunError: ``host`` cannot be listened on.
    """
    view = run.scene_view(up)
    server, url = start_server(host, port)
    page = Page(server, EditSession(run, device=device), read_history(run), view, device=device)
    return page, add_panels(page), url
