# SPDX-License-Identifier: Apache-2.0
"""LPIPS with AlexNet: how different two pictures look, by the features of a network.

R. Zhang, P. Isola, A. Efros, E. Shechtman, O. Wang, "The Unreasonable Effectiveness of Deep Features as a
Perceptual Metric", CVPR 2018; version 0.1 of its weights.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ggwarp.io.guarded import FileError, FileKind, check_file
from ggwarp.io.printable import printable
from ggwarp.types import Float32

Lpips = Callable[[Float32, Float32], float | None]
"""Of two [h, w, 3] images in 0..1; lower is closer; None: they are too small."""

LAYERS = ((3, 64, 11), (64, 192, 5), (192, 384, 3), (384, 256, 3), (256, 256, 3))
"""Channels in and out and the side of the kernel of AlexNet's five convolutions."""
WEIGHTS = FileKind("LPIPS' weights", 64 << 20)

_STRIDES, _PADDINGS = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)
_POOLED = (1, 2)  # layers before which the largest of 3 x 3 is taken
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of colours in -1..1, by channel
_EPSILON = 1e-10
_LEAST_SIDE = 64  # pixels; of a smaller picture the last layers see little but its border

_log = logging.getLogger(__name__)


def weights_file() -> Path:
    """Return where the weights lie once ``ggwarp doctor --fetch lpips`` has fetched them."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ggwarp" / "lpips.safetensors"


def shapes() -> dict[str, tuple[int, ...]]:
    """Return the weights' arrays: ``conv0.kernel`` [out, in, k, k], ``conv0.bias``, ``head0`` [out], ..."""
    found: dict[str, tuple[int, ...]] = {}
    for number, (inside, out, side) in enumerate(LAYERS):
        found |= {f"conv{number}.kernel": (out, inside, side, side), f"conv{number}.bias": (out,)}
        found[f"head{number}"] = (out,)
    return found


def lpips(weights: Mapping[str, Float32], *, device: str = "cpu") -> Lpips:
    """Return the measure.

    Args:
        weights: as in :func:`shapes`.
        device: torch's, where the network is computed.
    """
    import torch
    from torch.nn import functional as F

    arrays = {
        name: torch.from_numpy(np.asarray(array, np.float32)).to(device) for name, array in weights.items()
    }
    shift, scale = (torch.tensor(v, device=device)[:, None, None] for v in (_SHIFT, _SCALE))

    def features(image: Float32) -> Any:
        x = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1), np.float32)).to(device)
        x = ((2.0 * x - 1.0 - shift) / scale)[None]
        for number in range(len(LAYERS)):
            if number in _POOLED:
                x = F.max_pool2d(x, 3, 2)
            kernel, bias = arrays[f"conv{number}.kernel"], arrays[f"conv{number}.bias"]
            x = F.relu(F.conv2d(x, kernel, bias, stride=_STRIDES[number], padding=_PADDINGS[number]))
            yield x / (x.square().sum(dim=1, keepdim=True).sqrt() + _EPSILON)

    def distance(image: Float32, reference: Float32) -> float | None:
        if min(image.shape[:2]) < _LEAST_SIDE:
            return None
        with torch.no_grad():
            pairs = zip(features(image), features(reference), strict=True)
            parts = [
                ((a - b).square() * arrays[f"head{number}"][:, None, None]).sum(dim=1).mean()
                for number, (a, b) in enumerate(pairs)
            ]
            return float(sum(parts))

    return distance


def read_weights(path: Path) -> dict[str, Float32]:
    """Read what ``ggwarp doctor --fetch lpips`` stored.

    Raises:
        FileError: the file cannot be read, or is none.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    check_file(path, WEIGHTS)
    remedy = "remove it, and fetch it again: ggwarp doctor --fetch lpips"
    try:
        arrays = load_file(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise FileError(f"{printable(str(path))}: cannot be read ({error}); {remedy}") from None
    if {name: array.shape for name, array in arrays.items()} != shapes():
        raise FileError(f"{printable(str(path))}: these are not LPIPS' weights; {remedy}")
    return arrays


def open_lpips(device: str = "cpu") -> Lpips | None:
    """Return the measure if its weights are on this machine, else None.

    Nothing is ever downloaded; one line of the log says what is missing.

    Args:
        device: of the run.
    """
    path = weights_file()
    if not path.exists():
        _log.info("LPIPS is not measured: ggwarp doctor --fetch lpips gets its weights (10 MB)")
        return None
    try:
        weights = read_weights(path)
    except FileError as error:
        _log.warning("LPIPS is not measured: %s", error)
        return None
    import torch

    return lpips(weights, device=device if torch.cuda.is_available() else "cpu")
