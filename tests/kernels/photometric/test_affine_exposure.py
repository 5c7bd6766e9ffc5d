# SPDX-License-Identifier: Apache-2.0
"""Exposure against NumPy in double precision, finite differences, and torch's Adam."""

import numpy as np
import pytest
import torch
import warp as wp

from ggwarp.kernels.math import vec6
from ggwarp.kernels.photometric import affine_exposure
from ggwarp.kernels.workspaces import allocate_exposure

HEIGHT, WIDTH = 21, 37
PADDED = (32, 48)


@pytest.fixture(autouse=True, params=["the device's own", "columns"])
def grain(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cuts the image as CUDA does, too."""
    if request.param == "columns":
        monkeypatch.setattr(affine_exposure, "_grain", lambda width, device: (16, width))


class Pass:
    """One exposure pass over a random render, and the loss sum(weights * exposed)."""

    def __init__(self, rng: np.random.Generator, device: str) -> None:
        self.device = device
        self.image = np.zeros((20, *PADDED), np.float32)
        self.image[:, :HEIGHT, :WIDTH] = rng.uniform(0.0, 0.9, (20, HEIGHT, WIDTH))
        self.weights = rng.normal(size=(4, *PADDED)).astype(np.float32)
        self.values = np.array([0.2, -0.1, 0.3, 0.02, -0.05, 0.04], np.float32)
        self.workspace = allocate_exposure(HEIGHT, WIDTH, PADDED, device=device)

    def exposed(self, image: np.ndarray | None = None) -> np.ndarray:
        affine_exposure.expose(
            wp.array(self.image if image is None else image, dtype=float, device=self.device),
            wp.array(self.values[None], dtype=vec6, device=self.device),
            height=HEIGHT,
            width=WIDTH,
            exposed=self.workspace.exposed,
            device=self.device,
        )
        return self.workspace.exposed.numpy()

    def adjoint(self) -> tuple[np.ndarray, np.ndarray]:
        d_image = wp.array(self.weights, dtype=float, device=self.device)
        affine_exposure.expose_adjoint(
            wp.array(self.image, dtype=float, device=self.device),
            wp.array(self.values[None], dtype=vec6, device=self.device),
            height=HEIGHT,
            width=WIDTH,
            d_image=d_image,
            workspace=self.workspace,
            device=self.device,
        )
        return d_image.numpy(), self.workspace.bins.numpy().sum(axis=0)

    def reference(self, image: np.ndarray, values: np.ndarray) -> np.ndarray:
        colour = image[:3, :HEIGHT, :WIDTH].astype(np.float64)
        a, b = values.astype(np.float64).reshape(2, 3, 1, 1)
        return np.minimum(np.exp(a) * colour + b, 1.0)


def test_exposes_by_channel_and_keeps_the_depth(device: str, rng: np.random.Generator) -> None:
    case = Pass(rng, device)
    out = case.exposed()[:, :HEIGHT, :WIDTH]
    np.testing.assert_allclose(out[:3], case.reference(case.image, case.values), atol=1e-6)
    assert out[:3].max() == 1.0, "some of it is cut"
    np.testing.assert_array_equal(out[3], case.image[3, :HEIGHT, :WIDTH])


def test_gradient_is_that_of_finite_differences(device: str, rng: np.random.Generator) -> None:
    case = Pass(rng, device)
    case.image *= 0.6  # nowhere cut
    d_image, d_exposure = case.adjoint()
    weights = case.weights[:3, :HEIGHT, :WIDTH].astype(np.float64)

    def loss(values: np.ndarray) -> float:
        return float((weights * case.reference(case.image, values)).sum())

    for k in range(6):
        step = 1e-5 * np.eye(6)[k]
        slope = (loss(case.values + step) - loss(case.values - step)) / 2e-5
        assert d_exposure[k] == pytest.approx(slope, rel=1e-4, abs=1e-3)
    gain = np.exp(case.values[:3])[:, None, None]
    np.testing.assert_allclose(d_image[:3, :HEIGHT, :WIDTH], gain * weights, rtol=1e-5)
    np.testing.assert_array_equal(d_image[3], case.weights[3])
    np.testing.assert_array_equal(d_image[:, HEIGHT:], case.weights[:, HEIGHT:])


def test_where_it_is_cut_only_darkening_passes(device: str, rng: np.random.Generator) -> None:
    case = Pass(rng, device)
    case.image[:3] = 1.5
    d_image, d_exposure = case.adjoint()
    weights = case.weights[:3, :HEIGHT, :WIDTH]
    darker = np.maximum(weights, 0.0)  # a step against the gradient lowers the value
    gain = np.exp(case.values[:3])[:, None, None]
    np.testing.assert_allclose(d_image[:3, :HEIGHT, :WIDTH], gain * darker, rtol=1e-5)
    np.testing.assert_allclose(d_exposure[3:], darker.sum(axis=(1, 2)), rtol=1e-4)


def test_steps_are_adam_s_with_a_pull_to_nothing(device: str, rng: np.random.Generator) -> None:
    case = Pass(rng, device)
    values = wp.array(case.values[None], dtype=vec6, device=device)
    moments = wp.zeros(2, dtype=vec6, device=device)
    steps = wp.zeros(1, dtype=wp.int32, device=device)
    expected = torch.tensor(case.values, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([expected], lr=1e-2, eps=1e-15)
    for k in range(12):
        gradients = rng.normal(size=(affine_exposure.BINS, 6)).astype(np.float32)
        gradients[:] = 0.0 if k > 8 else gradients
        case.workspace.bins.assign(gradients)
        affine_exposure.step_exposure(
            values, rate=1e-2, pull=0.5, moments=moments, steps=steps, workspace=case.workspace, device=device
        )
        expected.grad = torch.tensor(gradients.sum(axis=0, dtype=np.float64)) + 0.5 * expected.detach()
        adam.step()
        np.testing.assert_allclose(values.numpy()[0], expected.detach().numpy(), atol=1e-5)
    before = values.numpy()
    case.workspace.bins.fill_(float("nan"))
    affine_exposure.step_exposure(
        values, rate=1e-2, pull=0.5, moments=moments, steps=steps, workspace=case.workspace, device=device
    )
    np.testing.assert_array_equal(values.numpy(), before)
    assert steps.numpy()[0] == 12
