# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.evaluation import image


@pytest.fixture
def pair(rng):
    reference = rng.random((40, 50, 3)).astype(np.float32)
    noisy = np.clip(reference + 0.1 * rng.standard_normal(reference.shape), 0, 1).astype(np.float32)
    return noisy, reference


def test_psnr_of_a_known_error():
    reference = np.zeros((4, 4, 3), np.float32)
    everywhere = np.ones((4, 4), bool)
    assert image.psnr(reference + 0.1, reference, everywhere) == pytest.approx(20.0, abs=1e-5)
    assert image.psnr(reference, reference, everywhere) == np.inf


def test_psnr_leaves_invalid_pixels_out(pair):
    noisy, reference = pair
    valid = np.zeros(noisy.shape[:2], bool)
    valid[:20] = True
    spoilt = noisy.copy()
    spoilt[20:] = 0.0
    assert image.psnr(spoilt, reference, valid) == image.psnr(noisy, reference, valid)


def test_matched_finds_gain_and_offset_of_each_channel(rng):
    seen = rng.uniform(0.2, 0.6, (20, 30, 3)).astype(np.float32)
    valid = rng.random((20, 30)) < 0.7
    reference = (seen * np.float32([1.2, 0.9, 1.1]) + np.float32([0.02, 0.1, -0.1])).astype(np.float32)
    spoilt = np.where(valid[..., None], reference, 1.0).astype(np.float32)
    np.testing.assert_allclose(image.matched(seen, spoilt, valid)[valid], reference[valid], atol=1e-6)
    assert image.psnr(image.matched(seen, spoilt, valid), spoilt, valid) > 100.0


def test_matched_survives_pictures_without_contrast_or_pixels():
    grey, darker = (np.full((4, 4, 3), v, np.float32) for v in (0.5, 0.3))
    everywhere = np.ones((4, 4), bool)
    np.testing.assert_allclose(image.matched(grey, darker, everywhere), darker, atol=1e-7)
    np.testing.assert_array_equal(image.matched(grey, darker, ~everywhere), grey)


def test_ssim_against_its_definition(pair):
    noisy, reference = (p.astype(np.float64) for p in pair)
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets**2) / (2 * 1.5**2))
    window = np.outer(window, window) / window.sum() ** 2
    values = []
    for y in range(5, 35):
        for x in range(5, 45):
            a, b = (p[y - 5 : y + 6, x - 5 : x + 6] for p in (noisy, reference))
            w = window[..., None]
            ma, mb = (w * a).sum((0, 1)), (w * b).sum((0, 1))
            va, vb = (w * a * a).sum((0, 1)) - ma**2, (w * b * b).sum((0, 1)) - mb**2
            vab = (w * a * b).sum((0, 1)) - ma * mb
            c1, c2 = 0.01**2, 0.03**2
            values.append((2 * ma * mb + c1) * (2 * vab + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2)))
    everywhere = np.ones(noisy.shape[:2], bool)
    assert image.ssim(*pair, everywhere) == pytest.approx(np.mean(values), abs=1e-5)


def test_ssim_sees_invalid_pixels_as_black_in_both(pair):
    noisy, reference = pair
    valid = np.zeros(noisy.shape[:2], bool)
    valid[:, :25] = True
    spoilt = noisy.copy()
    spoilt[:, 25:] = 1.0
    assert image.ssim(spoilt, reference, valid) == image.ssim(noisy, reference, valid)
    assert image.ssim(reference, reference, valid) == pytest.approx(1.0)


def test_depth_error_counts_readings_only():
    reference = np.array([[1.0, 0.0], [2.0, 0.0]], np.float32)
    assert image.depth_l1(np.array([[1.1, 9.0], [1.8, 9.0]], np.float32), reference) == pytest.approx(0.15)


def test_nothing_valid_is_not_measured(pair):
    noisy, reference = pair
    nothing = np.zeros(noisy.shape[:2], bool)
    assert image.psnr(noisy, reference, nothing) is None
    assert image.ssim(noisy, reference, nothing) is None
    assert image.depth_l1(noisy[..., 0], np.zeros_like(noisy[..., 0])) is None
    tiny = np.zeros((8, 8, 3), np.float32)
    assert image.ssim(tiny, tiny, np.ones((8, 8), bool)) is None
