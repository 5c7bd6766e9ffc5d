# SPDX-License-Identifier: Apache-2.0
"""Pictures that contradict the map, and are not to be baked into it.

A picture of which half the pixels that the map explains are clipped where it is not, or of other colours
whatever the exposure, is left out whole: no robust estimate holds beyond a half. Single clipped pixels count:
what is white or black may be so, and the map not yet.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ggwarp.types import Float32, Frame, Rendered

_TOLERANCE = 0.05
"""The map explains a pixel where their depths differ by less than this share: three standard deviations of a
Kinect at 4 m (Nguyen et al., 2012), and a pose that is a little off."""
_DARK, _BRIGHT = 4.0 / 255.0, 250.0 / 255.0
_APART = 0.1
"""A clipped pixel is wrong where the map is this far from the end of the scale."""
_DIFFERENT = 0.2
"""Of the scale, in a channel: colours this far apart are not those of one place in one light."""
_OPAQUE = 0.95
_BREAKDOWN = 0.5
_LEAST = 0.05
"""Share of a picture that the map must explain before it can be contradicted."""


def clipped_share(frame: Frame, rendered: Rendered) -> float:
    """Return the share of what the map explains of a picture that is clipped there, and not in the map.

    Args:
        frame: at the map's image size, with depth.
        rendered: the map's view from its pose.
    """
    explained = _explained(frame, rendered)
    return 0.0 if explained is None else _clipped(*explained)


def different_share(frame: Frame, rendered: Rendered) -> float:
    """Return the share of what the map explains of a picture that has other colours, at its best exposure.

    Gain and offset of each channel are those of medians and median deviations, which half of the pixels
    cannot move; or none, where the map's own exposure fits better.

    Args:
        frame, rendered: as of :func:`clipped_share`.
    """
    explained = _explained(frame, rendered)
    return 0.0 if explained is None else _different(*explained)


def unusable(frame: Frame, rendered: Rendered) -> str:
    """Say why a picture is left out whole, having been compared with the map's view; empty: it is used.

    Args:
        frame: with depth; some of its pixels are enough.
        rendered: the map's view from its pose, at the same pixels.
    """
    if (explained := _explained(frame, rendered)) is None:
        return ""
    share, said = _clipped(*explained), "is clipped"
    if share <= _BREAKDOWN:
        # Nearly always few pixels differ, whatever the exposure, and it need not be found.
        share, said = _share_apart(*explained), "has other colours"
        share = _different(*explained) if share > _BREAKDOWN else share
    return f"{100.0 * share:.0f} % of what the map knows of it {said}" if share > _BREAKDOWN else ""


def _clipped(seen: Float32, known: Float32) -> float:
    """Return the share of pixels, colours [3, n] each, that are clipped in the picture and not in the map."""
    white = ((seen >= _BRIGHT) & (known < _BRIGHT - _APART)).any(axis=0)
    black = ((seen <= _DARK) & (known > _DARK + _APART)).all(axis=0)
    return float(np.mean(white | black))


def _different(seen: Float32, known: Float32) -> float:
    """Return the share of pixels, colours [3, n] each, that differ at the best exposure, or at none."""
    middle, known_middle = (np.median(values, axis=1, keepdims=True) for values in (seen, known))
    spread, known_spread = (
        np.median(np.abs(values - centre), axis=1, keepdims=True)
        for values, centre in ((seen, middle), (known, known_middle))
    )
    exposed = (known - known_middle) * (spread / np.maximum(known_spread, 1e-3)) + middle
    return min(_share_apart(seen, known), _share_apart(seen, exposed))


def _explained(frame: Frame, rendered: Rendered) -> tuple[Float32, Float32] | None:
    """Return the colours [3, n] of the pixels that the map explains, in the picture and in it; None: too few.

    That is where the map is opaque and where the depth says it is.
    """
    assert frame.depth is not None
    there = (rendered.opacity > _OPAQUE) & (frame.depth > 0.0)
    there &= np.abs(rendered.surface_depth - frame.depth) < _TOLERANCE * frame.depth
    at = np.flatnonzero(there)  # ten times as fast as the mask itself where there are channels
    if len(at) < _LEAST * there.size:
        return None
    seen = np.ascontiguousarray(frame.rgb.reshape(-1, 3).take(at, axis=0).T)
    known = np.ascontiguousarray(rendered.rgb.reshape(-1, 3).take(at, axis=0).T)
    return np.asarray(seen.astype(np.float32) / np.float32(255.0), np.float32), known


def _share_apart(seen: Float32, colours: NDArray[np.floating]) -> float:
    return float(np.mean((np.abs(seen - colours) > _DIFFERENT).any(axis=0)))
