# SPDX-License-Identifier: Apache-2.0
"""Pictures of the map as files: colour, depth, object ids, identity features."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.io.atomic import atomic_write
from ggwarp.types import Float32, Rendered


class RenderWriter:
    """Writes ``frame%06d_{rgb,depth,objects,features}.png`` into one folder.

    Depth is that of the surface, 16-bit, millimetres; objects are 8- or 16-bit ids as the masks
    name them; features are the identity image's three principal components, with one basis for the
    whole run.
    """

    def __init__(self, folder: Path, identities: Float32 | None) -> None:
        """Prepare the features' basis where the map has ``identities`` [n, 16]."""
        self._folder = folder
        self._basis = None if identities is None or len(identities) < 2 else feature_basis(identities)
        self._views: list[list[Path]] = []  # the files of each

    def write(self, index: int, view: Rendered) -> None:
        """Write the pictures of frame ``index``.

        Raises:
            OSError: a file cannot be written.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        self._views.append([])
        self._save(index, "rgb", np.rint(view.rgb[..., ::-1] * 255.0).astype(np.uint8))
        self._save(index, "depth", depth_to_millimetres(view.surface_depth))
        if view.objects is not None:
            ids = np.clip(view.objects, 0, 65535)
            self._save(index, "objects", ids.astype(np.uint8 if ids.max(initial=0) < 256 else np.uint16))
        if view.identity is not None and self._basis is not None:
            self._save(index, "features", feature_image(view.identity, self._basis)[..., ::-1])

    def make_room(self, needed: int) -> None:
        """Remove views on a full disk, the newest first, until one is gone and ``needed`` bytes are free."""
        removed = 0
        with contextlib.suppress(OSError):
            while self._views and (not removed or shutil.disk_usage(self._folder).free < needed):
                for path in self._views.pop():
                    path.unlink()
                    removed += 1
            if not self._views:
                self._folder.rmdir()

    def _save(self, index: int, what: str, image: NDArray[Any]) -> None:
        path = self._folder / f"frame{index:06d}_{what}.png"
        # Not imwrite: it reports a full disk as False, without the reason.
        with atomic_write(path) as file:
            file.write(cv2.imencode(".png", image)[1].tobytes())
        self._views[-1].append(path)


def depth_to_millimetres(depth: Float32) -> NDArray[np.uint16]:
    """Return ``depth`` [h, w] in metres as 16-bit millimetres; 0 where there is none."""
    finite = np.where(np.isfinite(depth), depth, 0.0)
    return np.clip(np.rint(1000.0 * finite), 0, 65535).astype(np.uint16)


def feature_basis(identities: Float32) -> tuple[Float32, Float32]:
    """Return the mean [16] and the scaled principal axes [16, 3] of ``identities`` [n, 16].

    The axes are scaled so that two standard deviations to either side span 0..1 when 0.5 is added.
    """
    mean = identities.mean(0)
    values, vectors = np.linalg.eigh(np.cov(identities - mean, rowvar=False))
    axes = vectors[:, ::-1][:, :3]
    # An eigenvector's sign is arbitrary: fix it, so that two runs give the same colours.
    axes = axes * np.sign(axes[np.abs(axes).argmax(0), range(3)])
    spread = np.sqrt(np.maximum(values[::-1][:3], 1e-12))
    return mean.astype(np.float32), (axes / (4.0 * spread)).astype(np.float32)


def feature_image(identity: Float32, basis: tuple[Float32, Float32]) -> NDArray[np.uint8]:
    """Return ``identity`` [h, w, 16] as RGB [h, w, 3] in ``basis``."""
    mean, axes = basis
    return np.rint(255.0 * np.clip((identity - mean) @ axes + 0.5, 0.0, 1.0)).astype(np.uint8)
