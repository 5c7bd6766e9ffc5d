# SPDX-License-Identifier: Apache-2.0
"""Whether registered depth is bent as the colour's lens bends, or straight, where the recording does not say.

Drivers differ: a Kinect's registers to an ideal camera, an Azure Kinect's to the colour's own pixels. Of the
edges of depth that the two readings put elsewhere, those of the right one lie on edges of the picture.

Six sequences (two Kinects, three renderers), each bent by the lenses of two Kinects, two Azure Kinects and a
D435: of straight depth the preference is at most 0.006, that of the benchmark's own fr1/xyz. Of bent depth it
is 0.04 to 0.15, but for one sequence whose edges are few, and for the D435's lens, which moves nothing by a
pixel: there it stays below the threshold, and depth counts as straight.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.base import Dataset, FrameError
from ggwarp.datasets.plan.correspondence import edges_of_depth, gradients_of_colour

_SAMPLES = 8
LEAST_PREFERENCE = 0.03
"""Above it, depth is bent."""
_FEWEST = 60
"""Pixels on edges that the readings put elsewhere, of all frames, that say something."""


def preference(straight: Dataset, bent: Dataset) -> float | None:
    """Return by how much the pictures prefer bent depth to straight, in ranks of gradients, -1 to 1.

    Args:
        straight, bent: the same recording, read in the two ways.

    Returns:
        None where there are too few edges to tell.
    """
    last = len(straight) - 1
    ranks: tuple[list[float], list[float]] = ([], [])
    for index in sorted(set(np.linspace(0, last, _SAMPLES).astype(int).tolist())):
        try:
            frames = straight[index], bent[index]
        except FrameError:
            continue
        depths = [frame.depth for frame in frames if frame.depth is not None]
        if len(depths) < 2:
            continue
        gradients = gradients_of_colour(frames[0].rgb)
        edges = [edges_of_depth(depth) for depth in depths]
        for found, own, other in zip(ranks, edges, edges[::-1], strict=True):
            found += gradients[own & ~_near(other)].tolist()
    return None if min(map(len, ranks)) < _FEWEST else float(np.mean(ranks[1]) - np.mean(ranks[0]))


def _near(edges: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return cv2.dilate(edges.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
