# SPDX-License-Identifier: Apache-2.0
"""Direct alignment's normal equations, against NumPy's residuals and their finite differences."""

import dataclasses

import numpy as np
import pytest
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.photometric import alignment
from ggwarp.solvers.alignment_arrays import AlignmentLoopArrays, Comparison, Reference, view_rows

CAMERA = Camera(70, 11, 60.0, 62.0, 34.2, 5.1)
NOISE, ROBUST, EDGE = 0.05, 3.0, 0.05
EXPOSURE = (0.12, -0.03)
MOTION = se3.se3_exp([0.03, -0.02, 0.015, 0.004, -0.006, 0.01])


def smooth(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    v, u = np.mgrid[:h, :w]
    waves = [np.sin(a * u + b * v + c) for a, b, c in rng.uniform(0.05, 0.5, (3, 3))]
    return 0.5 + 0.3 * np.stack(waves, -1)


def views(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    h, w = CAMERA.height, CAMERA.width
    rendered = np.zeros((h, w, 4), np.float32)
    rendered[..., :3] = smooth(rng, h, w)
    v, u = np.mgrid[:h, :w]
    rendered[..., 3] = 2.0 + 0.004 * u + 0.01 * v
    rendered[3, 20:23, 3] = 0.0  # a hole
    rendered[:, 50:, 3] += 0.7  # an edge
    observed = np.ones((h, w, 4), np.float32)
    observed[..., :3] = smooth(rng, h, w)
    return rendered, observed


def compared(rendered: np.ndarray) -> np.ndarray:
    z = rendered[..., 3]
    inner, jump = z[1:-1, 1:-1], EDGE * z[1:-1, 1:-1]
    ok = inner > 0
    for other in (z[1:-1, :-2], z[1:-1, 2:], z[:-2, 1:-1], z[2:, 1:-1]):
        ok &= np.abs(other - inner) <= jump
    return np.argwhere(ok) + 1


def residuals(
    rendered: np.ndarray, observed: np.ndarray, pixels: np.ndarray, T: np.ndarray, a: float, b: float
) -> np.ndarray:
    """[n, 3]; NaN where the pixel is not seen."""
    v, u = pixels.T
    seen = rendered[v, u].astype(np.float64)
    z = seen[:, 3]
    x = np.stack([(u - CAMERA.cx) * z / CAMERA.fx, (v - CAMERA.cy) * z / CAMERA.fy, z], -1)
    x = se3.transform_points(T, x)
    p = CAMERA.fx * x[:, 0] / x[:, 2] + CAMERA.cx
    q = CAMERA.fy * x[:, 1] / x[:, 2] + CAMERA.cy
    h, w = observed.shape[:2]
    inside = (p >= 0) & (q >= 0) & (p < w - 1) & (q < h - 1) & (x[:, 2] > 0.05)
    p, q = np.where(inside, p, 0.0), np.where(inside, q, 0.0)
    j, i = p.astype(int), q.astype(int)
    s, t = (p - j)[:, None], (q - i)[:, None]
    o = observed[..., :3].astype(np.float64)
    value = (1 - t) * ((1 - s) * o[i, j] + s * o[i, j + 1])
    value += t * ((1 - s) * o[i + 1, j] + s * o[i + 1, j + 1])
    r = np.exp(a) * seen[:, :3] + b - value
    return np.where(inside[:, None], r, np.nan)


def system(
    rendered: np.ndarray,
    observed: np.ndarray,
    motion: np.ndarray,
    device: str,
    depth_noise: float = 0.0,
    agreement: float = 0.0,
    stride: int = 1,
    piece: int = 64,
) -> np.ndarray:
    size = alignment.AlignmentSize(intrinsics_of(CAMERA), *rendered.shape[:2], stride, piece)
    comparison = Comparison(NOISE, depth_noise, ROBUST, EDGE, agreement)
    arrays = AlignmentLoopArrays(2, [size], device)
    arrays.loop.folded.fill_(7.0)
    arrays.loop.systems.fill_(7.0)
    reference = reference_to(rendered, observed, device)
    arrays.load([reference], motion, [EXPOSURE], comparison)
    alignment.linearisation(arrays.loop, level=0, size=size, references=1, device=device)()
    return arrays.read(1)[2][0]


def reference_to(rendered: np.ndarray, observed: np.ndarray, device: str) -> Reference:
    """Return a reference at the origin that ``observed`` is compared with."""
    levels = [wp.array(x, dtype=wp.vec4, device=device) for x in (rendered, observed)]
    return Reference(levels, np.eye(4), view_rows(levels[:1], levels[1:]))


def test_references_are_summed_each_by_itself(device: str, rng: np.random.Generator) -> None:
    """At their own poses and exposures, in arrays with room for more."""
    size = alignment.AlignmentSize(intrinsics_of(CAMERA), CAMERA.height, CAMERA.width, 2)
    comparison = Comparison(NOISE, 0.02, ROBUST, EDGE, 0.0)
    pairs = [views(rng) for _ in range(3)]
    poses = [se3.se3_exp(rng.normal(0.0, 0.01, 6)) for _ in range(3)]
    exposures = [(float(a), float(b)) for a, b in rng.normal(0.0, 0.05, (3, 2))]
    references = [
        dataclasses.replace(reference_to(*pair, device), T_cw=pose)
        for pair, pose in zip(pairs, poses, strict=True)
    ]

    def found(numbers: list[int], room: int) -> np.ndarray:
        arrays = AlignmentLoopArrays(room, [size], device)
        chosen = [references[r] for r in numbers]
        arrays.load(chosen, MOTION, [exposures[r] for r in numbers], comparison)
        alignment.linearisation(arrays.loop, level=0, size=size, references=len(numbers), device=device)()
        return arrays.read(len(numbers))[2]

    together = found([0, 1, 2], 4)
    assert together.any(axis=1).all()
    np.testing.assert_array_equal(together, np.concatenate([found([r], 1) for r in range(3)]))


def test_sums_in_two_steps_are_those_in_one(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a GPU adds them, on a CPU; fewer rows than there are to fold to, and more."""
    for scale in (1, 3):
        big = [np.tile(view, (scale, scale, 1)) for view in views(rng)]
        one = system(*big, MOTION, "cpu", 0.02)
        monkeypatch.setattr(alignment, "folds", lambda items, device: True)
        two = system(*big, MOTION, "cpu", 0.02)
        monkeypatch.undo()
        np.testing.assert_allclose(two, one, rtol=1e-12, atol=1e-12 * np.abs(one).max())
    size = alignment.AlignmentSize(intrinsics_of(CAMERA), *big[0].shape[:2])
    assert size.items > alignment.FOLDED


@pytest.mark.parametrize("piece", [1, 7, 256])
@pytest.mark.parametrize("stride", [1, 3])
def test_pieces_of_any_length_sum_the_same_pixels(device, rng, stride: int, piece: int) -> None:
    pair = views(rng)
    expected = system(*pair, MOTION, device, 0.02, stride=stride)
    found = system(*pair, MOTION, device, 0.02, stride=stride, piece=piece)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("stride", [2, 3, 5, 100])
def test_every_nth_pixel_counts(stride: int, device: str, rng: np.random.Generator) -> None:
    """The sum is of those pixels, each compared in a picture that has no depth but about it."""
    rendered, observed = (np.tile(view, (2, 2, 1)) for view in views(rng))
    found = system(rendered, observed, MOTION, device, 0.02, stride=stride)
    pixels = compared(rendered)
    expected = np.zeros(alignment.SUMS)
    for row, column in pixels[(pixels % stride == stride // 2).all(axis=1)]:
        window = np.s_[row - 1 : row + 2, column - 1 : column + 2]
        alone = np.zeros_like(rendered)
        alone[window] = rendered[window]
        expected += system(alone, observed, MOTION, device, 0.02)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def test_normal_equations_are_those_of_the_residuals(device: str, rng: np.random.Generator) -> None:
    rendered, observed = views(rng)
    pixels = compared(rendered)
    r = residuals(rendered, observed, pixels, MOTION, *EXPOSURE)
    seen = np.isfinite(r).all(1)
    J = np.zeros((*r.shape, 8))
    for k in range(8):
        step = np.zeros(8)
        step[k] = 1e-6
        ends = [
            residuals(
                rendered,
                observed,
                pixels,
                se3.se3_exp(sign * step[:6]) @ MOTION,
                EXPOSURE[0] + sign * step[6],
                EXPOSURE[1] + sign * step[7],
            )
            for sign in (1.0, -1.0)
        ]
        J[..., k] = (ends[0] - ends[1]) / 2e-6
    # At a pixel's border the interpolated picture has a kink, where differences say nothing.
    smooth_there = np.isfinite(J).all((1, 2)) & (np.abs(J).max((1, 2)) < 1e3)
    assert smooth_there[seen].all()
    e2 = (r[seen] ** 2).sum(1) / NOISE**2
    share = ROBUST**2 / (ROBUST**2 + e2)
    w = share**2 / NOISE**2
    H = np.einsum("n,nci,ncj->ij", w, J[seen], J[seen])
    g = np.einsum("n,nci,nc->i", w, J[seen], r[seen])

    out = system(rendered, observed, MOTION, device)
    assert out[45] == seen.sum() > 300
    np.testing.assert_allclose(out[44], (e2 * share).sum(), rtol=1e-4)
    np.testing.assert_allclose(out[:36], H[np.triu_indices(8)], rtol=2e-3, atol=2e-4 * np.abs(H).max())
    np.testing.assert_allclose(out[36:44], g, rtol=2e-3, atol=2e-4 * np.abs(g).max())


def ramp(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Views of one place, with depth, whose colours rise everywhere."""
    rendered, observed = views(rng)
    observed[..., :3] = 0.03 * np.arange(CAMERA.width)[:, None]
    observed[..., 3] = rendered[..., 3].max(axis=0)
    return rendered, observed


def test_colour_of_another_surface_is_left_out(device: str, rng: np.random.Generator) -> None:
    rendered, observed = ramp(rng)
    everywhere = system(rendered, observed, np.eye(4), device)
    np.testing.assert_array_equal(system(rendered, observed, np.eye(4), device, agreement=0.1), everywhere)
    observed[:, 10:14, 3] = 0.0
    observed[:, 30:36, 3] = 1.0
    some = system(rendered, observed, np.eye(4), device, agreement=0.1)
    column = compared(rendered)[:, 1]
    hidden = ((column >= 10) & (column < 14)) | ((column >= 30) & (column < 36))
    assert some[45] == everywhere[45] - hidden.sum() < everywhere[45]


def test_what_is_flat_says_nothing_of_the_pose(device: str, rng: np.random.Generator) -> None:
    rendered, observed = ramp(rng)
    everywhere = system(rendered, observed, np.eye(4), device, agreement=0.1)
    observed[:, 25:41, :3] = 0.5 + 0.01 * rng.uniform(-1, 1, (CAMERA.height, 16, 3))  # noise alone
    some = system(rendered, observed, np.eye(4), device, agreement=0.1)
    column = compared(rendered)[:, 1]
    inside, about = ((column >= 25 + k) & (column < 40 - k) for k in (1, -1))
    assert inside.sum() <= everywhere[45] - some[45] <= about.sum()
    assert system(rendered, observed, np.eye(4), device)[45] == everywhere[45], "where it is not asked"


def test_depth_adds_point_to_plane_residuals(device: str, rng: np.random.Generator) -> None:
    """Against finite differences of n . (y - x), with n and y held: y is a reading, n the render's."""
    rendered, observed = views(rng)
    observed[..., 3] = 2.1 + 0.003 * np.mgrid[: CAMERA.height, : CAMERA.width][1]
    sigma = 0.08
    added = system(rendered, observed, MOTION, device, sigma) - system(rendered, observed, MOTION, device)
    H, g = np.zeros((8, 8)), np.zeros(8)
    for v, u in compared(rendered):

        def lifted(view: np.ndarray, v: int, u: int) -> np.ndarray:
            z = float(view[v, u, 3])
            return np.array([(u - CAMERA.cx) * z / CAMERA.fx, (v - CAMERA.cy) * z / CAMERA.fy, z])

        across = lifted(rendered, v, u + 1) - lifted(rendered, v, u - 1)
        n = np.cross(across, lifted(rendered, v + 1, u) - lifted(rendered, v - 1, u))
        n = MOTION[:3, :3] @ (n / np.linalg.norm(n))
        x = se3.transform_points(MOTION, lifted(rendered, v, u)[None])[0]
        j = round(CAMERA.fx * x[0] / x[2] + CAMERA.cx)
        i = round(CAMERA.fy * x[1] / x[2] + CAMERA.cy)
        if not (0 <= i < CAMERA.height and 0 <= j < CAMERA.width):
            continue
        y = lifted(observed, i, j)
        J = np.zeros(8)
        for k, step in enumerate(1e-6 * np.eye(6)):
            ends = [se3.transform_points(se3.se3_exp(s * step), x[None])[0] for s in (1.0, -1.0)]
            J[k] = (n @ (y - ends[0]) - n @ (y - ends[1])) / 2e-6
        e = n @ (y - x)
        w = (ROBUST**2 / (ROBUST**2 + (e / sigma) ** 2)) ** 2 / sigma**2
        H += w * np.outer(J, J)
        g += w * e * J
    # Rounding to the nearest reading may differ for a pixel or two on the border between them.
    np.testing.assert_allclose(added[:36], H[np.triu_indices(8)], rtol=2e-2, atol=5e-3 * np.abs(H).max())
    np.testing.assert_allclose(added[36:44], g, rtol=2e-2, atol=1e-2 * np.abs(g).max())
    assert added[44] == added[45] == 0.0


def test_a_second_call_gives_the_same_bits(device: str, rng: np.random.Generator) -> None:
    rendered, observed = views(rng)
    first = system(rendered, observed, MOTION, device)
    assert (system(rendered, observed, MOTION, device) == first).all()


@pytest.mark.parametrize("motion", [se3.se3_exp([0, 0, -9.0, 0, 0, 0]), se3.se3_exp([50.0, 0, 0, 0, 0, 0])])
def test_what_is_behind_or_beside_the_camera_is_not_compared(device: str, rng, motion: np.ndarray) -> None:
    assert not system(*views(rng), motion, device).any()


def test_without_depth_nothing_is_compared(device: str, rng: np.random.Generator) -> None:
    rendered, observed = views(rng)
    rendered[..., 3] = 0.0
    assert not system(rendered, observed, MOTION, device).any()
