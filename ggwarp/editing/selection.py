# SPDX-License-Identifier: Apache-2.0
"""Which Gaussians are an object's.

Gaussian Grouping takes those above a class probability of 0.3, cuts outliers by interquartile ranges and adds
what lies in the convex hull. On the built-in office (52 objects, IoU with the truth, in space by opacity
and area / in images): stored ids 0.877 / 0.936, and 0.3 chooses the same; with quartile fences 0.876 / 0.914;
with the hull 0.763 / 0.833; with stray parts cut 0.901 / 0.925. So ids are the default, outliers
are strays away from the main parts, and cutting them is for what leaves the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.boxes import main_parts
from ggwarp.map.gaussians import Gaussians
from ggwarp.objects.linear_classifier import LinearClassifier
from ggwarp.types import Float32

Bools = NDArray[np.bool_]

_CLOSE = 2.5  # distances between an object's Gaussians
_CLOSE_LIMITS = (0.01, 0.05)  # metres
_FAR = 3.0  # times the distance to the object
_KIN = 3


@dataclass(frozen=True)
class SelectionConfig:
    """How an object's Gaussians are chosen."""

    probability: float | None = None
    """Take all whose probability of being the object's is above this (published: 0.3); None: those whose
    stored id is the object's, each Gaussian then being one object's at most."""
    adopt: bool = True
    """Add those on the object's surface whose own kind is elsewhere (:func:`orphans`)."""
    cut_outliers: bool = False
    """Drop those away from the object's main parts (:func:`ggwarp.geometry.boxes.main_parts`)."""
    fill_hull: bool = False
    """Add all within the convex hull of the chosen."""


def select(
    gaussians: Gaussians,
    object_id: int,
    config: SelectionConfig = SelectionConfig(),
    *,
    classifier: LinearClassifier | None = None,
) -> Bools:
    """Return [n] which of ``gaussians`` belong to ``object_id``.

    Args:
        classifier: needed for ``config.probability``.

    Raises:
        ValueError: the map lacks what the choice rests on.
    """
    if config.probability is None:
        if gaussians.object_ids is None:
            raise ValueError("the map has no object ids")
        chosen = gaussians.object_ids == object_id
    else:
        if gaussians.identities is None or classifier is None:
            raise ValueError("a probability needs the map's identities and their classifier")
        chosen = classifier.probabilities(gaussians.identities, object_id) > config.probability
    adopted = orphans(gaussians, chosen) if config.adopt else np.zeros_like(chosen)
    if config.cut_outliers:
        chosen[chosen] = main_parts(gaussians.means[chosen])
    if config.fill_hull:
        chosen |= within_hull(gaussians.means, gaussians.means[chosen])
    return chosen | adopted


def orphans(gaussians: Gaussians, chosen: Bools) -> Bools:
    """Return [n] the Gaussians close to the ``chosen`` that are far from all others of their own id.

    A mask and a depth image disagree by a pixel at an object's outline: Gaussians seeded there lie on the
    object and are called wall. Close: within 2.5 distances between the object's own; far: three times as
    far from the three nearest of their id that are not close as from the object.
    """
    found = np.zeros(len(gaussians), bool)
    if gaussians.object_ids is None or chosen.sum() < 4:
        return found
    from scipy.spatial import KDTree  # heavy, and only needed for edits

    means = gaussians.means
    body = means[chosen][main_parts(means[chosen])]
    tree: Any = KDTree(body)
    gap = float(np.median(tree.query(body, k=2)[0][:, 1]))
    reach = float(np.clip(_CLOSE * gap, *_CLOSE_LIMITS))
    near = np.nonzero(~chosen & (means > body.min(0) - reach).all(1) & (means < body.max(0) + reach).all(1))[
        0
    ]
    distances = tree.query(means[near], distance_upper_bound=reach)[0]
    near, distances = near[np.isfinite(distances)], distances[np.isfinite(distances)]
    close = np.zeros(len(gaussians), bool)
    close[near] = True
    for identifier in np.unique(gaussians.object_ids[near]).tolist():
        own = gaussians.object_ids[near] == identifier
        kin = means[(gaussians.object_ids == identifier) & ~close]
        if len(kin) >= _KIN:
            away = KDTree(kin).query(means[near[own]], k=_KIN)[0].mean(axis=1)
            found[near[own]] = away > _FAR * np.maximum(distances[own], gap)
    return found


def within_hull(points: Float32, corners: Float32) -> Bools:
    """Return [n] which of ``points`` [n, 3] the convex hull of ``corners`` [m, 3] holds; a flat one none."""
    from scipy.spatial import ConvexHull, QhullError  # heavy, and seldom needed

    try:
        hull: Any = ConvexHull(corners.astype(np.float64))
    except (QhullError, ValueError):
        return np.zeros(len(points), bool)
    near = ((points >= corners.min(0)) & (points <= corners.max(0))).all(axis=1)
    distances = points[near] @ hull.equations[:, :3].T + hull.equations[:, 3]
    near[near] = (distances <= 1e-6).all(axis=1)
    return near
