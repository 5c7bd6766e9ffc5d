# SPDX-License-Identifier: Apache-2.0
"""A run's scene as one HTML file, which any browser shows without a network and without ggwarp."""

from __future__ import annotations

import html
from pathlib import Path

from ggwarp.geometry.upright import Up
from ggwarp.io.atomic import atomic_write
from ggwarp.results.saved_run import SavedRun
from ggwarp.viewer import colours, scene
from ggwarp.viewer.history import read_history
from ggwarp.viewer.server import LOCAL, start_server, stop_server

_WORKERS_OF_FILES = """
    // Browsers give a file's page no worker from a blob that is a module, and without its worker viser draws
    // splats in any order. They do from a data URL.
    if (location.protocol === "file:") {
      const Plain = window.Worker;
      window.Worker = class extends Plain {
        constructor(url, options) {
          if (String(url).startsWith("blob:") && options?.type === "module") {
            const request = new XMLHttpRequest();
            request.open("GET", url, false);
            request.send();
            url = "data:text/javascript;charset=utf-8," + encodeURIComponent(request.responseText);
          }
          super(url, options);
        }
      };
    }
    """


def write_scene(run: SavedRun, path: Path, up: Up | None = None) -> None:
    """Write the map, the trajectory and the loops of ``run`` to ``path``.

    Args:
        up: which way is up; None: as the run's folder says, or estimated.

    Raises:
        OSError: it cannot be written.
    """
    view, history = run.scene_view(up), read_history(run)
    server, _ = start_server(LOCAL, 0)
    try:
        scene.begin_with(server, view, run.camera)
        shades = colours.splat_colours(run.gaussians, colours.COLOUR, eye=view.start[:3, 3])
        scene.show_splats(server.scene, scene.MAP, run.gaussians, shades)
        scene.add_trajectories(server.scene, run.poses, history.live, history.loops)
        text = server.get_scene_serializer().as_html(dark_mode=True)
        text = text.replace("<head>", f"<head>\n    <script>{_WORKERS_OF_FILES}</script>", 1)
        text = text.replace(
            "<title>Viser</title>", f"<title>{html.escape(run.folder.resolve().name)}</title>", 1
        )
    finally:
        stop_server(server)
    with atomic_write(path) as file:
        file.write(text.encode())
