# SPDX-License-Identifier: Apache-2.0
"""On CUDA an op works on torch's current stream: else it would read tensors that are not yet written."""

import contextlib

import numpy as np
import pytest
import torch
import warp as wp

from benchmarking.inputs.walls import walls
from ggwarp.geometry.camera import Camera
from ggwarp.ops import gicp, knn, neighbours, registration, render, rendering, similarity, ssim


def a_registration():
    points, quats = (torch.tensor(x, dtype=torch.float32) for x in walls(np.random.default_rng(0), 300))
    covariances = torch.eye(3).repeat(300, 1, 1) * 1e-4
    gicp(points, covariances, points, quats, torch.full((300, 3), 0.01))


def a_picture():
    n = 5
    means = torch.rand(n, 3) + torch.tensor([0.0, 0.0, 1.0])
    means.requires_grad_()
    camera = Camera(16, 16, 16.0, 16.0, 7.5, 7.5)
    parts = (torch.rand(n, 4), torch.full((n, 3), -2.0), torch.zeros(n), torch.rand(n, 3), None)
    image, _, _ = render(means, *parts, torch.eye(4), camera)
    image.sum().backward()


def a_similarity():
    image = torch.rand(3, 12, 12, requires_grad=True)
    ssim(image, torch.rand(3, 12, 12)).backward()


@pytest.mark.parametrize(
    ("module", "work"),
    [
        (neighbours, lambda: knn(torch.rand(50, 3), k=3)),
        (neighbours, lambda: neighbours.ellipses(torch.rand(50, 3))),
        (registration, a_registration),
        (rendering, a_picture),
        (similarity, a_similarity),
    ],
)
def test_every_launch_is_in_order_with_torch(monkeypatch, module, work):
    inside, launches = [], []

    @contextlib.contextmanager
    def scope(tensor):
        inside.append(tensor)
        yield
        inside.pop()

    def launch(*arguments, **words):
        launches.append(bool(inside))
        return launched(*arguments, **words)

    launched = wp.launch
    monkeypatch.setattr(module, "on_stream_of", scope)
    monkeypatch.setattr(wp, "launch", launch)
    work()
    assert launches and all(launches)
