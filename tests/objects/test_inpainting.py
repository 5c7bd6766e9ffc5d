# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.objects.inpainting import inpaint_depth, inpaint_opencv, inpaint_shade


def _ramp() -> np.ndarray:
    v, u = np.mgrid[:40, :60]
    return np.stack([40 + 3 * u, 60 + 2 * v, 120 + u - v], axis=-1).astype(np.uint8)


def _mask() -> np.ndarray:
    mask = np.zeros((40, 60), bool)
    mask[12:28, 20:40] = True
    return mask


@pytest.mark.parametrize("inpaint", [inpaint_opencv, inpaint_shade])
def test_only_the_hole_is_made_up(inpaint):
    picture, mask = _ramp(), _mask()
    ruined = picture.copy()
    ruined[mask] = 255
    filled = inpaint(ruined, mask)
    np.testing.assert_array_equal(filled[~mask], picture[~mask])
    assert filled.dtype == np.uint8
    assert np.abs(filled[mask].astype(int) - picture[mask]).mean() < 12


def test_shade_goes_on():
    """A slope is continued: exactly what makes it better than interpolation."""
    picture, mask = _ramp(), _mask()
    ruined = picture.copy()
    ruined[mask] = 0
    assert np.abs(inpaint_shade(ruined, mask)[mask].astype(int) - picture[mask]).max() <= 6


def test_it_stays_dark_under_what_casts_a_shadow():
    v, u = np.mgrid[:41, :41] - 20
    dark = (200 - 120 * np.exp(-(u**2 + v**2) / 200.0))[..., None].repeat(3, 2).astype(np.uint8)
    mask = u**2 + v**2 < 49
    ruined = np.where(mask[..., None], np.uint8(0), dark)
    errors = [
        np.abs(f(ruined, mask)[mask] - dark[mask].astype(int)).mean() for f in (inpaint_shade, inpaint_opencv)
    ]
    assert errors[0] < 0.85 * errors[1]


@pytest.mark.parametrize("inpaint", [inpaint_opencv, inpaint_shade])
def test_nothing_or_all_unknown(inpaint):
    picture = _ramp()
    none = np.zeros(picture.shape[:2], bool)
    np.testing.assert_array_equal(inpaint(picture, none), picture)
    assert inpaint(picture, ~none).shape == picture.shape


def test_depth():
    true = (2.5 + 0.02 * np.mgrid[:20, :20][0]).astype(np.float32)
    mask = np.zeros((20, 20), bool)
    mask[5:12, 5:12] = True
    depth = np.where(mask, np.float32(np.nan), true)
    filled = inpaint_depth(depth, mask)
    np.testing.assert_array_equal(filled[~mask], true[~mask])
    np.testing.assert_allclose(filled, true, atol=0.03)
