# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.se3 import quats_from_matrices
from ggwarp.map.gaussians import SH_C0
from ggwarp.objects.classifier import IdentitySeeds
from ggwarp.pipeline.mapping.seeding import (
    SeedingConfig,
    choose_pixels,
    seed_density,
    seed_gaussians,
    surface_normals,
)
from ggwarp.types import Exposure, Frame, Rendered

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
CONFIG = SeedingConfig()


def tilted_plane(normal: np.ndarray, distance: float) -> np.ndarray:
    """Depth of the plane n . p = -distance."""
    x = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    y = ((np.arange(CAMERA.height) - CAMERA.cy) / CAMERA.fy)[:, None]
    return (-distance / (normal[0] * x + normal[1] * y + normal[2])).astype(np.float32)


def frame(depth: np.ndarray, rgb: np.ndarray | None = None) -> Frame:
    grey = np.full((*depth.shape, 3), 128, np.uint8)
    return Frame(3, 0.0, grey if rgb is None else rgb, depth)


def view(depth: np.ndarray, opacity: float = 1.0, grey: float = 128 / 255) -> Rendered:
    return Rendered(
        np.full((*depth.shape, 3), grey, np.float32), depth, depth, np.full(depth.shape, opacity, np.float32)
    )


def everywhere(depth: np.ndarray) -> np.ndarray:
    """Return the normals of all pixels."""
    rows, columns = np.indices(depth.shape).reshape(2, -1)
    return surface_normals(depth, CAMERA, rows, columns).reshape(*depth.shape, 3)


def test_normals_of_a_plane_point_to_the_camera() -> None:
    normal = np.array([0.3, -0.2, -1.0])
    normal /= np.linalg.norm(normal)
    normals = everywhere(tilted_plane(normal, 2.0))[4:-4, 4:-4]
    np.testing.assert_allclose(normals, np.broadcast_to(normal, normals.shape), atol=0.01)


def test_no_normal_across_a_depth_edge_or_without_depth() -> None:
    depth = np.full((48, 64), 1.0, np.float32)
    depth[:, 32:] = 3.0
    depth[10, 10] = 0.0
    normals = everywhere(depth)
    assert not normals[20, 31:33].any() and not normals[10, 10].any()
    assert np.isfinite(normals).all()


@pytest.mark.parametrize("density", [0.05, 0.3, 1.0])
def test_pixels_are_drawn_at_the_density(density: float) -> None:
    rows, cols = choose_pixels(np.full((200, 300), density, np.float32), 5)
    assert len(rows) == pytest.approx(density * 60_000, rel=0.01)
    blocks = np.histogram2d(rows, cols, bins=(10, 15))[0]
    independent = np.sqrt(400 * density * (1.0 - density))
    assert blocks.std() <= 0.5 * independent, "more evenly than by independent draws"


def test_gaussians_lie_on_the_surface_and_flat_on_it(rng: np.random.Generator) -> None:
    normal = np.array([0.0, -0.6, -0.8])
    depth = tilted_plane(normal, 2.0)
    T_wc = se3.se3_exp(rng.normal(size=6) * 0.3)
    seen = frame(depth)
    density = seed_density(seen, None, CONFIG)

    batch = seed_gaussians(seen, T_wc, CAMERA, density, CONFIG, identities=None, rng=rng)

    local = (batch.means - T_wc[:3, 3]) @ T_wc[:3, :3]
    np.testing.assert_allclose(local @ normal, -2.0, atol=1e-4)
    inside = (np.abs(local[:, :2] / local[:, 2:]) < [0.4, 0.3]).all(axis=1)
    thin = np.array([se3.matrix_from_quat(q)[:, 2] for q in batch.quats[inside]])
    assert (np.abs(thin @ (T_wc[:3, :3] @ normal)) > 0.999).all()
    scales = np.exp(batch.log_scales[inside])
    assert (scales[:, 0] >= scales[:, 1] - 1e-6).all() and (scales[:, 1] > scales[:, 2]).all()


def test_nothing_is_added_where_the_map_explains_the_picture() -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    assert not seed_density(frame(depth), view(depth), CONFIG).any()


@pytest.mark.parametrize(
    "rendered",
    [
        pytest.param(view(np.full((48, 64), 2.0, np.float32), opacity=0.2), id="transparent"),
        pytest.param(view(np.full((48, 64), 3.0, np.float32)), id="behind the new surface"),
        pytest.param(view(np.full((48, 64), 2.0, np.float32), grey=0.9), id="of another colour"),
    ],
)
def test_gaussians_are_added_where_the_map_is_wrong(rendered: Rendered) -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    assert (seed_density(frame(depth), rendered, CONFIG) > 0.05).all()
    full = np.full_like(depth, 1.0)
    assert not seed_density(frame(depth), rendered, CONFIG, present=full).any(), "it is full already"


def test_new_surface_is_filled_up_and_wrong_colour_to_one_a_pixel() -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    empty, wrong = view(depth, opacity=0.2), view(depth, grey=0.9)
    wanted = seed_density(frame(depth), empty, CONFIG)
    for share in (0.0, 0.4, 1.0):
        found = seed_density(frame(depth), empty, CONFIG, present=share * wanted)
        np.testing.assert_allclose(found, (1.0 - share) * wanted, atol=1e-6)
    more = seed_density(frame(depth), wrong, CONFIG)
    for present in (0.0, 0.7, 0.95):
        found = seed_density(frame(depth), wrong, CONFIG, present=np.full_like(depth, present))
        np.testing.assert_allclose(found, np.minimum(more, 1.0 - present), atol=1e-6)


def test_gaussians_between_others_are_as_small_as_those(rng: np.random.Generator) -> None:
    seen = frame(np.full((48, 64), 2.0, np.float32))
    sizes = {}
    for new, present in ((0.4, 0.0), (0.1, 0.3)):
        density, others = (np.full((48, 64), d, np.float32) for d in (new, present))
        batch = seed_gaussians(
            seen, np.eye(4), CAMERA, density, CONFIG, identities=None, rng=rng, present=others
        )
        assert len(batch.means) == pytest.approx(new * 48 * 64, rel=0.1)
        sizes[new] = np.median(batch.log_scales[:, 1])
    assert sizes[0.1] == pytest.approx(sizes[0.4], abs=1e-3)


def test_no_depth_no_gaussian(rng: np.random.Generator) -> None:
    nothing = frame(np.zeros((48, 64), np.float32))
    density = seed_density(nothing, None, CONFIG)
    batch = seed_gaussians(nothing, np.eye(4), CAMERA, density, CONFIG, identities=None, rng=rng)
    assert len(batch) == 0


def test_detail_draws_more_gaussians() -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    rgb = np.full((48, 64, 3), 128, np.uint8)
    rgb[:, 32:] = 255 * (np.indices((48, 32)).sum(axis=0) // 2 % 2)[..., None]
    density = seed_density(frame(depth, rgb), None, SeedingConfig(min_density=0.1, max_density=0.6))
    assert density[:, 40:].mean() > 3.0 * density[:, :24].mean()


def test_identities_start_from_their_object_s_code(rng: np.random.Generator) -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    classes = np.zeros((48, 64), np.int32)
    classes[:, 32:] = 1
    classes[:10] = -1
    codes = rng.normal(size=(2, 16)).astype(np.float32)
    seen = frame(depth)
    density = seed_density(seen, None, CONFIG)
    batch = seed_gaussians(
        seen,
        np.eye(4),
        CAMERA,
        density,
        CONFIG,
        identities=IdentitySeeds(codes, classes, classes),
        rng=rng,
    )
    rows, cols = choose_pixels(density, seen.index)
    assert batch.identities is not None
    nearest = ((batch.identities[:, None] - codes) ** 2).sum(axis=2).argmin(axis=1)
    known = rows >= 10
    assert (nearest[known] == (cols[known] >= 32)).all()
    assert batch.votes is not None and (batch.votes == known).all()


def test_quaternions_of_many_rotations(rng: np.random.Generator) -> None:
    R = np.stack([se3.so3_exp(w) for w in rng.normal(size=(200, 3)) * 2.0] + [np.diag([1.0, -1.0, -1.0])])
    quats = quats_from_matrices(R)
    back = np.stack([se3.matrix_from_quat(q) for q in quats])
    np.testing.assert_allclose(back, R, atol=1e-6)


def test_seeds_have_the_maps_exposure_not_the_pictures() -> None:
    rng = np.random.default_rng(4)
    depth = np.full((48, 64), 2.0, np.float32)
    true = rng.uniform(0.2, 0.7, (48, 64, 3))
    exposure = Exposure((0.2, 0.1, -0.3), (0.02, -0.03, 0.05))
    seen = np.exp(exposure.log_gain) * true + exposure.offset
    taken = frame(depth, np.rint(255 * seen).astype(np.uint8))
    density = seed_density(taken, None, CONFIG, exposure)
    arguments: dict = {"identities": None, "rng": rng, "exposure": exposure}
    batch = seed_gaussians(taken, np.eye(4), CAMERA, density, CONFIG, **arguments)
    rows, cols = choose_pixels(density, taken.index)
    np.testing.assert_allclose(batch.colours * SH_C0 + 0.5, true[rows, cols], atol=0.004)
    shown = Rendered(true.astype(np.float32), depth, depth, np.ones_like(depth))
    assert not seed_density(taken, shown, CONFIG, exposure).any(), "the map explains the picture"
    assert seed_density(taken, shown, CONFIG).any(), "but not at its own exposure"
