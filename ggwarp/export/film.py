# SPDX-License-Identifier: Apache-2.0
"""A short film of the map along the run's path: an animated WebP, which browsers and chats play."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggwarp.editing.device import ready_device
from ggwarp.editing.map_view import MapView
from ggwarp.export.options import ExportOptions
from ggwarp.export.scene import ExportScene
from ggwarp.io.atomic import atomic_write

_MOST_FRAMES = 300  # 20 seconds
_FRAME_MS = 67
_QUALITY = 70


def write_film(scene: ExportScene, path: Path, options: ExportOptions) -> None:
    """Write the film, 20 seconds at most; of an object, with nothing else before black."""
    from PIL import Image

    step = max(options.every, -(-len(scene.poses) // _MOST_FRAMES))
    view = MapView(scene.gaussians, scene.run.camera, device=ready_device(options.device))
    frames = [
        Image.fromarray(np.rint(255.0 * view.render(T_wc).rgb).astype(np.uint8))
        for T_wc in scene.poses[::step]
    ]
    with atomic_write(path) as file:
        frames[0].save(
            file,
            "WEBP",
            save_all=True,
            append_images=frames[1:],
            duration=_FRAME_MS,
            loop=0,
            quality=_QUALITY,
        )
