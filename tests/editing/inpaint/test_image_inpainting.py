# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.editing.inpaint.image_inpainting import (
    CONTEXT,
    continued,
    inpaint_depth,
    inpaint_opencv,
    inpaint_shade,
    smoothed,
)


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
    filled = inpaint(ruined, mask, mask)
    np.testing.assert_array_equal(filled[~mask], picture[~mask])
    assert filled.dtype == np.uint8
    assert np.abs(filled[mask].astype(int) - picture[mask]).mean() < 12


def test_shade_goes_on():
    """A slope is continued: exactly what makes it better than interpolation."""
    picture, mask = _ramp(), _mask()
    ruined = picture.copy()
    ruined[mask] = 0
    assert np.abs(inpaint_shade(ruined, mask, mask)[mask].astype(int) - picture[mask]).max() <= 6


def test_what_is_not_wanted_does_not_matter():
    """Of a wide unknown part only the surroundings of what is wanted are solved for, with the same result."""
    v, u = np.mgrid[:60, :160]
    picture = np.stack([90 + 0.3 * u, 60 + 0.5 * v, 120 + 0.2 * (u - v)], axis=-1).astype(np.uint8)
    mask = (np.abs(v - 30) < 8) & (u > 20)
    wanted = mask & (np.abs(u - 45) < 5)
    ruined = np.where(mask[..., None], np.uint8(0), picture)
    whole, part = inpaint_shade(ruined, mask, mask), inpaint_shade(ruined, mask, wanted)
    assert np.abs(part[wanted].astype(int) - whole[wanted]).max() <= 1
    far = mask & (u > 45 + 5 + CONTEXT)
    np.testing.assert_array_equal(part[far], ruined[far])


def test_something_wanted_far_from_all_that_is_known():
    picture = np.full((90, 90, 3), 77, np.uint8)
    mask = np.zeros((90, 90), bool)
    mask[1:-1, 1:-1] = True
    wanted = np.zeros_like(mask)
    wanted[43:47, 43:47] = True
    filled = inpaint_shade(np.where(mask[..., None], np.uint8(0), picture), mask, wanted)
    np.testing.assert_array_equal(filled[wanted], picture[wanted])


def test_bricks_go_on():
    v, u = np.mgrid[:90, :120]
    mortar = (v % 9 == 0) | ((u + 10 * (v // 9 % 2)) % 20 == 0)
    picture = np.where(mortar, 200, 110 + 0.3 * u + 0.2 * v)[..., None].repeat(3, 2).astype(np.uint8)
    mask = np.zeros(mortar.shape, bool)
    mask[30:60, 40:80] = True
    ruined = np.where(mask[..., None], np.uint8(0), picture)
    errors = [
        np.abs(f(ruined, mask, mask)[mask] - picture[mask].astype(int)).mean()
        for f in (inpaint_shade, inpaint_opencv)
    ]
    assert errors[0] < 0.4 * errors[1]


def test_a_spline_under_tension_forgets_the_slope(rng):
    """A ramp goes on whatever the tension; a border that darkens towards a wide hole does not blacken it."""
    v, u = np.mgrid[:60, :60].astype(float)
    mask = np.hypot(v - 30, u - 30) < 20
    ramp = (3.0 * u - v)[..., None]
    ruined = np.where(mask[..., None], rng.uniform(size=(60, 60, 1)), ramp)
    for slope in (3.0, 1e4):
        np.testing.assert_allclose(continued(ruined, ~mask, mask, slope=slope), ramp, atol=1e-3)
    shadow = (100.0 - 5.0 * np.clip(26.0 - np.hypot(v - 30, u - 30), 0.0, 6.0))[..., None]
    shadow[0, 0] = 0.0  # there is black in the picture, so that nothing but tension stops the fall
    middle = [continued(shadow, ~mask, mask, slope=slope)[30, 30, 0] for slope in (3.0, 1e4)]
    assert 70.0 - 5.0 * 3.0 < middle[0] < 70.0  # no farther than the slope times its reach
    assert middle[1] < 35.0


def test_smoothing_keeps_slopes_up_to_the_outline():
    ramp, mask = _ramp().astype(float), _mask()
    np.testing.assert_allclose(smoothed(ramp, ~mask, 3.0)[~mask], ramp[~mask], atol=0.8)
    assert np.abs(smoothed(ramp, ~mask, 3.0)[~mask] - ramp[~mask]).mean() < 0.05


def test_it_stays_dark_under_what_casts_a_shadow():
    v, u = np.mgrid[:41, :41] - 20
    dark = (200 - 120 * np.exp(-(u**2 + v**2) / 200.0))[..., None].repeat(3, 2).astype(np.uint8)
    mask = u**2 + v**2 < 49
    ruined = np.where(mask[..., None], np.uint8(0), dark)
    errors = [
        np.abs(f(ruined, mask, mask)[mask] - dark[mask].astype(int)).mean()
        for f in (inpaint_shade, inpaint_opencv)
    ]
    assert errors[0] < 0.85 * errors[1]


@pytest.mark.parametrize("inpaint", [inpaint_opencv, inpaint_shade])
def test_nothing_or_all_unknown(inpaint):
    picture = _ramp()
    none = np.zeros(picture.shape[:2], bool)
    np.testing.assert_array_equal(inpaint(picture, none, none), picture)
    assert inpaint(picture, ~none, ~none).shape == picture.shape


def test_depth():
    true = (2.5 + 0.02 * np.mgrid[:20, :20][0]).astype(np.float32)
    mask = np.zeros((20, 20), bool)
    mask[5:12, 5:12] = True
    depth = np.where(mask, np.float32(np.nan), true)
    filled = inpaint_depth(depth, mask)
    np.testing.assert_array_equal(filled[~mask], true[~mask])
    np.testing.assert_allclose(filled, true, atol=0.03)
