# SPDX-License-Identifier: Apache-2.0
"""What a keyframe adds to the map, and that the kernels add what NumPy does."""

import dataclasses

import numpy as np
import pytest
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.math import vec6
from ggwarp.kernels.seeding import seeds
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import SH_C0, Gaussians
from ggwarp.map.renderer import Planes
from ggwarp.objects.classifier import IdentitySeeds
from ggwarp.pipeline.mapping.seeding import Seeder, SeedingConfig, Seen
from ggwarp.types import Exposure, Frame, Rendered
from tests.pipeline.mapping import seeding_reference as reference

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


class Seeding:
    """A map on a device, and what a frame adds to it."""

    def __init__(self, device: str, config: SeedingConfig = CONFIG, *, identity: bool = False) -> None:
        self.device = device
        self.map = GaussianMap(device=device, has_identity=identity, capacity=8)
        self.seeder = Seeder(config, CAMERA, self.map, flat=True)

    def seen(
        self,
        frame: Frame,
        rendered: Rendered | None = None,
        T_wc: np.ndarray | None = None,
        exposure: Exposure | None = None,
    ) -> Seen:
        planes = None
        if rendered is not None:
            image = np.concatenate([rendered.rgb.transpose(2, 0, 1), rendered.depth[None]])
            planes = Planes(*map(self.uploaded, (image, 1.0 - rendered.opacity, rendered.median_depth)))
        assert frame.depth is not None
        pose = np.eye(4) if T_wc is None else T_wc
        pixels = wp.array(frame.rgb, dtype=wp.uint8, device=self.device)
        depth = self.uploaded(frame.depth)
        values = Exposure() if exposure is None else exposure
        row = wp.array([[*values.log_gain, *values.offset]], dtype=vec6, device=self.device)
        return Seen(frame.index, pixels, depth, pose, row, planes)

    def uploaded(self, values: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=float, device=self.device)

    def density(
        self,
        frame: Frame,
        rendered: Rendered | None = None,
        exposure: Exposure | None = None,
        present: np.ndarray | None = None,
    ) -> np.ndarray:
        there = None if present is None else self.uploaded(present)
        seen = self.seen(frame, rendered, exposure=exposure)
        return self.seeder.density(seen, there).numpy().copy()

    def add(
        self,
        seen: Seen,
        density: np.ndarray,
        present: np.ndarray | None = None,
        identities: IdentitySeeds | None = None,
    ) -> Gaussians:
        there = None if present is None else self.uploaded(present)
        if identities is not None and identities.classes is not None:
            labels = (wp.array(x, dtype=int, device="cpu") for x in (identities.classes, identities.votes))
            identities = IdentitySeeds(identities.codes, *(x.to(self.map.device) for x in labels))
        before = self.map.count
        rng = np.random.default_rng(9)
        count = self.seeder.add(seen, self.uploaded(density), there, 5, identities, rng)
        assert self.map.count == before + count
        batch = self.map.to_host()
        assert batch.keyframe_ids is not None and (batch.keyframe_ids[before:] == 5).all()
        names = [f.name for f in dataclasses.fields(batch) if getattr(batch, f.name) is not None]
        return dataclasses.replace(batch, **{name: getattr(batch, name)[before:] for name in names})


@pytest.fixture
def seeding(device: str) -> Seeding:
    return Seeding(device)


def messy(rng: np.random.Generator) -> tuple[Frame, Rendered, np.ndarray]:
    """A frame with edges and holes, a view that is wrong in every way, and Gaussians that are there."""
    depth = tilted_plane(np.array([0.3, -0.2, -0.93]), 2.0)
    depth[10:25, 20:40] *= 0.6
    depth[rng.random(depth.shape) < 0.1] = 0.0
    rgb = rng.integers(0, 256, (48, 64, 3)).astype(np.uint8)
    rgb[:, :20] = 90
    shown = rng.uniform(-0.2, 1.2, (48, 64, 3)).astype(np.float32)
    opacity = rng.random((48, 64)).astype(np.float32)
    median = (depth * rng.choice([0.5, 1.0, 1.02, 1.5], depth.shape)).astype(np.float32)
    rendered = Rendered(np.clip(shown, 0, 1), median, median, opacity)
    return frame(depth, rgb), rendered, rng.uniform(0, 0.6, depth.shape).astype(np.float32)


@pytest.mark.parametrize("exposure", [Exposure(), Exposure((0.2, 0.1, -0.3), (0.02, -0.03, 0.05))])
def test_densities_are_numpy_s(seeding: Seeding, exposure: Exposure, rng: np.random.Generator) -> None:
    taken, rendered, present = messy(rng)
    for shown, there in ((None, None), (rendered, None), (rendered, present)):
        expected = reference.seed_density(taken, shown, CONFIG, exposure, present=there)
        assert expected.any()
        found = seeding.density(taken, shown, exposure, there)
        np.testing.assert_allclose(found, expected, atol=2e-5)


def test_gaussians_are_numpy_s(device: str, rng: np.random.Generator) -> None:
    taken, rendered, present = messy(rng)
    exposure, T_wc = Exposure((0.2, 0.1, -0.3), (0.02, -0.03, 0.05)), se3.se3_exp(rng.normal(size=6) * 0.4)
    density = reference.seed_density(taken, rendered, CONFIG, exposure, present=present)
    classes, votes = rng.integers(-1, 3, (2, 48, 64)).astype(np.int32)
    codes = rng.normal(size=(3, 16)).astype(np.float32)
    for identities in (None, IdentitySeeds(codes), IdentitySeeds(codes, classes, votes)):
        expected = reference.seed_gaussians(
            taken,
            T_wc,
            CAMERA,
            density,
            CONFIG,
            identities=identities,
            rng=np.random.default_rng(9),
            exposure=exposure,
            present=present,
        )
        seeding = Seeding(device, identity=identities is not None)
        for _ in range(2):  # into an empty map, and after others
            seen = seeding.seen(taken, rendered, T_wc, exposure)
            found = seeding.add(seen, density, present, identities)
            assert len(found) == len(expected) > 300
            np.testing.assert_allclose(found.means, expected.means, atol=2e-6)
            np.testing.assert_allclose(found.colours, expected.colours, atol=1e-5)
            np.testing.assert_allclose(found.opacity_logits, expected.opacity_logits, atol=1e-6)
            # A normal at an edge hangs on whether two depths are just within reach of each other.
            signs = np.sign((found.quats * expected.quats).sum(axis=1, keepdims=True))
            same = np.abs(found.quats * signs - expected.quats).max(axis=1) < 2e-3
            same &= np.abs(found.log_scales - expected.log_scales).max(axis=1) < 2e-3
            assert same.mean() > 0.99
            if identities is not None:
                assert found.identities is not None and expected.identities is not None
                np.testing.assert_allclose(found.identities, expected.identities, atol=1e-6)
                if identities.votes is not None:
                    np.testing.assert_array_equal(found.votes, expected.votes)


def test_what_is_not_written_is_zero(device: str, rng: np.random.Generator) -> None:
    seeding = Seeding(device, identity=True)
    for name in ("first", "steps", "low_weight_counts", "votes", "mean2d_gradient_counts"):
        seeding.map.fields[name].fill_(7)
    taken, _, _ = messy(rng)
    codes = np.zeros((1, 16), np.float32)
    seeding.add(seeding.seen(taken), np.full((48, 64), 0.5, np.float32), identities=IdentitySeeds(codes))
    for name in ("first", "steps", "low_weight_counts", "votes", "mean2d_gradient_counts"):
        assert not seeding.map.fields[name].numpy()[: seeding.map.count].any(), name


@pytest.mark.parametrize("density", [0.0, 0.05, 0.3, 1.0])
def test_pixels_are_drawn_at_the_density(density: float, device: str) -> None:
    wanted = wp.full((200, 300), density, dtype=float, device=device)
    chosen, numbers = (wp.empty(n, dtype=int, device=device) for n in 2 * [(200, 300)])
    seeds.choose_pixels(wanted, frame=5, chosen=chosen, numbers=numbers, device=device)
    drawn = chosen.numpy()
    np.testing.assert_array_equal(numbers.numpy().ravel(), drawn.ravel().cumsum())
    rows, columns = reference.choose_pixels(np.full((200, 300), density, np.float32), 5)
    np.testing.assert_array_equal(np.nonzero(drawn), (rows, columns))
    assert len(rows) == pytest.approx(density * 60_000, rel=0.01)
    blocks = np.histogram2d(rows, columns, bins=(10, 15))[0]
    independent = np.sqrt(400 * density * (1.0 - density))
    assert blocks.std() <= 0.5 * independent, "more evenly than by independent draws"


def normals_of(depth: np.ndarray, device: str) -> np.ndarray:
    surface = wp.array(depth, dtype=float, device=device)
    smooth, normals = (
        wp.empty(depth.shape, dtype=float, device=device),
        wp.empty(depth.shape, dtype=wp.vec3, device=device),
    )
    seeds.smoothed_depth(surface, smooth=smooth, device=device)
    seeds.surface_normals(
        surface, smooth=smooth, camera=intrinsics_of(CAMERA), normals=normals, device=device
    )
    return normals.numpy()


def test_normals_of_a_plane_point_to_the_camera(device: str) -> None:
    normal = np.array([0.3, -0.2, -1.0])
    normal /= np.linalg.norm(normal)
    normals = normals_of(tilted_plane(normal, 2.0), device)[4:-4, 4:-4]
    np.testing.assert_allclose(normals, np.broadcast_to(normal, normals.shape), atol=0.01)


def test_no_normal_across_a_depth_edge_or_without_depth(device: str) -> None:
    depth = np.full((48, 64), 1.0, np.float32)
    depth[:, 32:] = 3.0
    depth[10, 10] = 0.0
    normals = normals_of(depth, device)
    assert not normals[20, 31:33].any() and not normals[10, 10].any()
    assert np.isfinite(normals).all()


def test_gaussians_lie_on_the_surface_and_flat_on_it(seeding: Seeding, rng: np.random.Generator) -> None:
    normal = np.array([0.0, -0.6, -0.8])
    T_wc = se3.se3_exp(rng.normal(size=6) * 0.3)
    seen = seeding.seen(frame(tilted_plane(normal, 2.0)), T_wc=T_wc)

    batch = seeding.add(seen, seeding.seeder.density(seen).numpy().copy())

    local = (batch.means - T_wc[:3, 3]) @ T_wc[:3, :3]
    np.testing.assert_allclose(local @ normal, -2.0, atol=1e-4)
    inside = (np.abs(local[:, :2] / local[:, 2:]) < [0.4, 0.3]).all(axis=1)
    thin = np.array([se3.matrix_from_quat(q)[:, 2] for q in batch.quats[inside]])
    assert (np.abs(thin @ (T_wc[:3, :3] @ normal)) > 0.999).all()
    scales = np.exp(batch.log_scales[inside])
    assert (scales[:, 0] >= scales[:, 1] - 1e-6).all() and (scales[:, 1] > scales[:, 2]).all()


def test_nothing_is_added_where_the_map_explains_the_picture(seeding: Seeding) -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    assert not seeding.density(frame(depth), view(depth)).any()


@pytest.mark.parametrize(
    "rendered",
    [
        pytest.param(view(np.full((48, 64), 2.0, np.float32), opacity=0.2), id="transparent"),
        pytest.param(view(np.full((48, 64), 3.0, np.float32)), id="behind the new surface"),
        pytest.param(view(np.full((48, 64), 2.0, np.float32), grey=0.9), id="of another colour"),
    ],
)
def test_gaussians_are_added_where_the_map_is_wrong(seeding: Seeding, rendered: Rendered) -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    assert (seeding.density(frame(depth), rendered) > 0.05).all()
    full = np.full_like(depth, 1.0)
    assert not seeding.density(frame(depth), rendered, present=full).any(), "it is full already"


def test_new_surface_is_filled_up_and_wrong_colour_to_one_a_pixel(seeding: Seeding) -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    empty, wrong = view(depth, opacity=0.2), view(depth, grey=0.9)
    wanted = seeding.density(frame(depth), empty)
    for share in (0.0, 0.4, 1.0):
        found = seeding.density(frame(depth), empty, present=share * wanted)
        np.testing.assert_allclose(found, (1.0 - share) * wanted, atol=1e-6)
    more = seeding.density(frame(depth), wrong)
    for present in (0.0, 0.7, 0.95):
        found = seeding.density(frame(depth), wrong, present=np.full_like(depth, present))
        np.testing.assert_allclose(found, np.minimum(more, 1.0 - present), atol=1e-6)


def test_gaussians_between_others_are_as_small_as_those(seeding: Seeding) -> None:
    seen = seeding.seen(frame(np.full((48, 64), 2.0, np.float32)))
    sizes = {}
    for new, present in ((0.4, 0.0), (0.1, 0.3)):
        density, others = (np.full((48, 64), d, np.float32) for d in (new, present))
        batch = seeding.add(seen, density, others)
        assert len(batch) == pytest.approx(new * 48 * 64, rel=0.1)
        sizes[new] = np.median(batch.log_scales[:, 1])
    assert sizes[0.1] == pytest.approx(sizes[0.4], abs=1e-3)


def test_no_depth_no_gaussian(seeding: Seeding, rng: np.random.Generator) -> None:
    nothing = frame(np.zeros((48, 64), np.float32))
    assert not seeding.density(nothing).any()
    assert seeding.seeder.seed(seeding.seen(nothing), 0, None, rng) == 0 and seeding.map.count == 0


def test_rubbish_adds_nothing(seeding: Seeding, rng: np.random.Generator) -> None:
    depth = np.full((48, 64), np.nan, np.float32)
    depth[::2] = -1.0
    assert seeding.seeder.seed(seeding.seen(frame(depth)), 0, None, rng) == 0


def test_detail_draws_more_gaussians(device: str) -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    rgb = np.full((48, 64, 3), 128, np.uint8)
    rgb[:, 32:] = 255 * (np.indices((48, 32)).sum(axis=0) // 2 % 2)[..., None]
    density = Seeding(device, SeedingConfig(min_density=0.1, max_density=0.6)).density(frame(depth, rgb))
    assert density[:, 40:].mean() > 3.0 * density[:, :24].mean()


def test_quaternions_of_many_rotations(rng: np.random.Generator) -> None:
    R = np.stack([se3.so3_exp(w) for w in rng.normal(size=(200, 3)) * 2.0] + [np.diag([1.0, -1.0, -1.0])])
    quats = reference.quats_from_matrices(R)
    back = np.stack([se3.matrix_from_quat(q) for q in quats])
    np.testing.assert_allclose(back, R, atol=1e-6)


def test_seeds_have_the_maps_exposure_not_the_pictures(seeding: Seeding) -> None:
    rng = np.random.default_rng(4)
    depth = np.full((48, 64), 2.0, np.float32)
    true = rng.uniform(0.2, 0.7, (48, 64, 3))
    exposure = Exposure((0.2, 0.1, -0.3), (0.02, -0.03, 0.05))
    seen = np.exp(exposure.log_gain) * true + exposure.offset
    taken = frame(depth, np.rint(255 * seen).astype(np.uint8))
    density = seeding.density(taken, exposure=exposure)
    batch = seeding.add(seeding.seen(taken, exposure=exposure), density)
    rows, cols = reference.choose_pixels(density, taken.index)
    np.testing.assert_allclose(batch.colours * SH_C0 + 0.5, true[rows, cols], atol=0.004)
    shown = Rendered(true.astype(np.float32), depth, depth, np.ones_like(depth))
    assert not seeding.density(taken, shown, exposure).any(), "the map explains the picture"
    assert seeding.density(taken, shown).any(), "but not at its own exposure"
