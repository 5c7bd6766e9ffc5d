# SPDX-License-Identifier: Apache-2.0
"""Views of pictures and renders, and their halving."""

import numpy as np
import warp as wp

from ggwarp.kernels.photometric import image_pyramid

EDGE = 0.05


def test_halving_averages_and_knows_edges(device: str, rng: np.random.Generator) -> None:
    fine = rng.uniform(0, 1, (6, 9, 4)).astype(np.float32)
    fine[..., 3] = 2.0 + 0.01 * fine[..., 0]
    fine[0, 0, 3], fine[2, 2, 3] = 0.0, 3.0
    coarse = wp.zeros((3, 4), dtype=wp.vec4, device=device)
    image_pyramid.halve(wp.array(fine, dtype=wp.vec4, device=device), edge=EDGE, coarse=coarse, device=device)
    expected = fine[:6, :8].reshape(3, 2, 4, 2, 4).mean((1, 3))
    expected[0, 0, 3] = expected[1, 1, 3] = 0.0
    np.testing.assert_allclose(coarse.numpy(), expected, rtol=1e-6)


def test_views_of_a_picture_and_of_a_render(device: str, rng: np.random.Generator) -> None:
    rgb = rng.integers(0, 256, (5, 7, 3)).astype(np.uint8)
    view = wp.zeros((5, 7), dtype=wp.vec4, device=device)
    depth = rng.uniform(1, 2, (5, 7)).astype(np.float32)
    depth[0, :3] = np.nan, np.inf, 0.0
    colour = wp.array(rgb, dtype=wp.uint8, device=device)
    image_pyramid.pack_picture(colour, wp.array(depth, device=device), view=view, device=device)
    np.testing.assert_allclose(view.numpy()[..., :3], rgb / 255.0, rtol=1e-6)
    depth[0, :3] = 0.0
    np.testing.assert_array_equal(view.numpy()[..., 3], depth)
    image_pyramid.pack_picture(colour, None, view=view, device=device)
    assert not view.numpy()[..., 3].any()

    image = rng.uniform(0.1, 1, (4, 16, 16)).astype(np.float32)
    transmittance = rng.uniform(0, 0.1, (16, 16)).astype(np.float32)
    image_pyramid.pack_render(
        wp.array(image, device=device),
        wp.array(transmittance, device=device),
        min_opacity=0.95,
        view=view,
        device=device,
    )
    opacity = 1.0 - transmittance[:5, :7]
    depth = np.where(opacity >= 0.95, image[3, :5, :7] / opacity, 0.0)
    expected = np.concatenate([image[:3, :5, :7], depth[None]]).transpose(1, 2, 0)
    np.testing.assert_allclose(view.numpy(), expected, rtol=1e-5)
