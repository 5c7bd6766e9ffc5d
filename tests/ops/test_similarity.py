# SPDX-License-Identifier: Apache-2.0
"""The public SSIM op: value and gradient against the float64 oracle and scikit-image."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from ggwarp.ops import ssim
from ggwarp.ops.reference.losses import ssim_map


def pair(height, width, seed=0):
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(3, height, width, generator=generator)
    image = target + 0.2 * torch.rand(3, height, width, generator=generator)
    return image, target


def test_training_an_image_towards_another(device):
    image, target = (t.to(device) for t in pair(24, 30))
    image.requires_grad_()
    before = ssim(image, target)
    (1.0 - before).backward()
    with torch.no_grad():
        image -= 100.0 * image.grad
    assert before < ssim(image, target) <= 1.0


@settings(max_examples=20)
@given(height=st.integers(1, 30), width=st.integers(1, 30), seed=st.integers(0, 99))
def test_value_and_gradient(height, width, seed):
    image, target = pair(height, width, seed)
    image.requires_grad_()
    exact = image.detach().double().requires_grad_()
    got, want = ssim(image, target), ssim_map(exact, target.double()).mean()
    (3.0 * got).backward()
    (3.0 * want).backward()
    assert got.item() == pytest.approx(want.item(), abs=1e-5)
    g, w = image.grad.double().ravel(), exact.grad.ravel()
    assert (g - w).norm() <= 2e-3 * w.norm() + 1e-9
    assert g @ w >= 0.999 * g.norm() * w.norm() - 1e-12


def test_agrees_with_scikit_image_away_from_the_border(device):
    image, target = pair(60, 70)
    framed = torch.zeros_like(image), torch.zeros_like(target)
    for whole, part in zip(framed, (image, target), strict=True):
        whole[:, 16:44, 16:54] = part[:, 16:44, 16:54]
    # Zeros outside: the border rule does not matter, and scikit-image's full map can be averaged.
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    maps = [
        structural_similarity(x.numpy(), y.numpy(), full=True, **options)[1]
        for x, y in zip(*framed, strict=True)
    ]
    got = ssim(framed[0].to(device), framed[1].to(device))
    assert float(got) == pytest.approx(float(np.mean(maps)), abs=1e-5)


def test_a_slice_of_a_padded_render(device):
    image, target = (t.to(device) for t in pair(32, 32))
    view = image[:, :20, :27].requires_grad_()
    assert not view.is_contiguous()
    got = ssim(view, target[:, :20, :27])
    same = ssim(view.detach().contiguous(), target[:, :20, :27].contiguous())
    assert got.item() == same.item()
    got.backward()
    assert view.grad.shape == (3, 20, 27)


def test_backward_twice_gives_the_same(device):
    image, target = (t.to(device) for t in pair(9, 12))
    image.requires_grad_()
    value = ssim(image, target)
    first = torch.autograd.grad(value, image, retain_graph=True)[0]
    second = torch.autograd.grad(value, image)[0]
    assert torch.equal(first, second)


def test_equal_images(device):
    image = pair(11, 13)[0].to(device).requires_grad_()
    value = ssim(image, image.detach())
    value.backward()
    assert value.item() == pytest.approx(1.0, abs=1e-6)
    assert image.grad.abs().max() < 1e-5


def test_says_what_is_wrong():
    image, target = pair(8, 9)
    with pytest.raises(ValueError, match=r"image: .*\[8, 9\]"):
        ssim(image[0], target[0])
    with pytest.raises(ValueError, match=r"image: torch\.float64"):
        ssim(image.double(), target.double())
    with pytest.raises(ValueError, match=r"target: .*\[3, 7, 9\]"):
        ssim(image, target[:, 1:])
    with pytest.raises(ValueError, match=r"target\.detach"):
        ssim(image, target.requires_grad_())
