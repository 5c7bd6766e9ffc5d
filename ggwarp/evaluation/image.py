# SPDX-License-Identifier: Apache-2.0
"""How close a rendered image is to the photograph: PSNR (also in its exposure), SSIM, LPIPS, depth L1.

As in the papers, only pixels with a depth reading count: PSNR and depth L1 leave the others
out, SSIM and LPIPS see both images with those pixels set to black.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.types import Float32

_SSIM_WINDOW = 11  # pixels: what scikit-image gives a Gaussian of sigma 1.5

Bools = NDArray[np.bool_]


def psnr(image: Float32, reference: Float32, valid: Bools) -> float | None:
    """Return the peak signal-to-noise ratio over ``valid`` pixels, dB.

    Args:
        image, reference: [h, w, 3] in 0..1.
        valid: [h, w].

    Returns:
        dB; infinity for equal images, None when no pixel is valid.
    """
    if not valid.any():
        return None
    error = float(np.mean((image[valid].astype(np.float64) - reference[valid]) ** 2))
    return float("inf") if error == 0.0 else -10.0 * float(np.log10(error))


def matched(image: Float32, reference: Float32, valid: Bools) -> Float32:
    """Return ``image`` in the exposure of ``reference``: the best gain and offset of each channel.

    Args:
        image, reference: [h, w, 3] in 0..1.
        valid: [h, w], where they are compared; without contrast there the gain stays 1.

    Returns:
        [h, w, 3] in 0..1.
    """
    if not valid.any():
        return image
    x, y = (i[valid].astype(np.float64) for i in (image, reference))
    centred = x - x.mean(axis=0)
    spread = (centred**2).sum(axis=0)
    gain = np.where(spread > 1e-12, (centred * y).sum(axis=0) / np.maximum(spread, 1e-12), 1.0)
    offset = y.mean(axis=0) - gain * x.mean(axis=0)
    return np.clip(image * gain + offset, 0.0, 1.0).astype(np.float32)


def ssim(image: Float32, reference: Float32, valid: Bools) -> float | None:
    """Return the structural similarity of the two images, black outside ``valid``.

    Gaussian window of 11 x 11 pixels and sigma 1.5, data range 1, averaged over channels and over the
    pixels whose window lies inside the image (Wang et al., 2004).

    Args:
        image, reference: [h, w, 3] in 0..1, at least 11 x 11 pixels.
        valid: [h, w].

    Returns:
        In -1..1; None when no pixel is valid or the image is smaller than the window.
    """
    if not valid.any() or min(valid.shape) < _SSIM_WINDOW:
        return None
    from skimage.metrics import structural_similarity  # heavy, and not needed before a run has ended

    shown = valid[..., None]
    similarity: Any = structural_similarity(
        image * shown,
        reference * shown,
        data_range=1.0,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    return float(similarity)


def depth_l1(depth: Float32, reference: Float32) -> float | None:
    """Return the mean absolute depth error where ``reference`` [h, w] has a reading, metres."""
    valid = reference > 0.0
    if not valid.any():
        return None
    return float(np.mean(np.abs(depth[valid] - reference[valid]), dtype=np.float64))
