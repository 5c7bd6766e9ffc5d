# SPDX-License-Identifier: Apache-2.0
"""Projection and its adjoint against the float64 oracle and finite differences."""

import numpy as np
import pytest
import torch
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.math import vec6, vec16
from ggwarp.kernels.raster.project import project
from ggwarp.kernels.raster.project_adjoint import pose_levels, project_adjoint
from ggwarp.kernels.raster.tiles import bin_splats
from ggwarp.kernels.workspaces import allocate_slot_gradients, allocate_splats, allocate_tiles
from ggwarp.ops.reference import render as oracle

# The principal point is well away from the middle.
CAMERA = Camera(60, 44, 50.0, 55.0, 36.3, 15.2)
FIELDS = ("means", "quats", "log_scales", "opacity_logits", "colours", "identities")
TYPES = dict(zip(FIELDS, (wp.vec3, wp.vec4, wp.vec3, float, wp.vec3, vec16), strict=True))
T_CW = se3.se3_exp([0.1, -0.2, 0.3, 0.2, -0.1, 0.3])


def make_scene(rng, n, *, spread=0.5):
    """Gaussians around a point in front of ``T_CW``, away from every clamp."""
    centres = rng.uniform([-spread, -spread, 1.0], [spread, spread, 3.0], (n, 3))
    centres[:, :2] *= centres[:, 2:]
    T_wc = se3.inverse(T_CW)
    return {
        "means": centres @ T_wc[:3, :3].T + T_wc[:3, 3],
        "quats": rng.normal(size=(n, 4)),
        "log_scales": np.log(rng.uniform(0.01, 0.15, (n, 3))),
        "opacity_logits": rng.uniform(-2, 3, n),
        "colours": rng.uniform(-1.5, 1.5, (n, 3)),
        "identities": rng.normal(size=(n, 16)),
    }


class Projector:
    """A scene's device arrays and the calls on them."""

    def __init__(self, scene, device, *, T_cw=T_CW, camera=CAMERA, identity=True):
        self.n, self.device, self.camera = len(scene["means"]), device, camera
        fields = FIELDS if identity else FIELDS[:-1]
        self.arrays = {
            k: wp.array(np.asarray(scene[k], np.float32), dtype=TYPES[k], device=device) for k in fields
        }
        self.T_cw = wp.array(np.asarray(T_cw, np.float32)[None], dtype=wp.mat44, device=device)
        self.splats = allocate_splats(self.n, device=device)

    def forward(self):
        project(
            *(self.arrays.get(k) for k in FIELDS),
            T_cw=self.T_cw,
            camera=intrinsics_of(self.camera),
            count=self.n,
            out=self.splats,
        )
        return self.splats

    def adjoint(self, d_means2d, d_conics, d_slopes, d_features, *, pose=True):
        """Spread per-Gaussian gradients over the Gaussians' slots and chain them."""
        size = {"width": self.camera.width, "height": self.camera.height}
        tiles = allocate_tiles(self.n, 20 * self.n, **size, device=self.device)
        splats = self.forward()
        bin_splats(splats.tile_rects, splats.depths, count=self.n, **size, out=tiles)
        slots = allocate_slot_gradients(tiles.capacity, d_features.shape[1], device=self.device)
        owner = tiles.slot_gaussians.numpy()
        share = 1.0 / np.maximum(np.bincount(owner[: tiles.counts.numpy()[1]], minlength=self.n), 1)
        weights = np.eye(4)[np.zeros(self.n, int)] * (1.0 + np.arange(self.n))[:, None]
        rows = np.concatenate([d_conics, d_means2d, d_slopes, d_features[:, :4], weights], 1)
        for out, values in ((slots.rows, rows), (slots.identities, d_features[:, 4:])):
            if out is not None:
                spread = (values * share[:, None])[owner if self.n else np.zeros(0, int)]
                out.assign(spread.astype(np.float32))
        gradients = {k: wp.zeros_like(a) for k, a in self.arrays.items()}
        self.weights = wp.full(self.n, -1.0, dtype=float, device=self.device)
        self.mean2d_gradients = (
            wp.full(self.n, 0.5, dtype=float, device=self.device),
            wp.full(self.n, 7, dtype=int, device=self.device),
        )
        scratch = tuple(wp.empty(k, dtype=vec6, device=self.device) for k in pose_levels(self.n))
        project_adjoint(
            *(self.arrays[k] for k in FIELDS[:5]),
            T_cw=self.T_cw,
            camera=intrinsics_of(self.camera),
            count=self.n,
            tiles=tiles,
            slots=slots,
            **{f"d_{k}": g for k, g in gradients.items()},
            weights=self.weights,
            mean2d_gradient_norms=self.mean2d_gradients,
            d_pose_scratch=scratch if pose else (),
        )
        result = {k: g.numpy() for k, g in gradients.items()}
        return result | ({"tau": scratch[-1].numpy()[0]} if pose else {})


def assert_gradients_agree(actual, expected, name=""):
    """gsplat's check: relative L2, cosine and signed bias, not only closeness."""
    a, e = np.asarray(actual, np.float64).ravel(), np.asarray(expected, np.float64).ravel()
    scale = np.linalg.norm(e)
    assert scale > 0, name
    assert np.linalg.norm(a - e) / scale < 1e-3, name
    assert a @ e / (np.linalg.norm(a) * scale) >= 0.999, name
    assert abs((a - e).sum()) / np.abs(e).sum() < 1e-3, name


def oracle_of(scene, *, T_cw=T_CW, camera=CAMERA, tau=None):
    tensors = {k: torch.tensor(v, dtype=torch.float64, requires_grad=True) for k, v in scene.items()}
    T = torch.tensor(T_cw, dtype=torch.float64)
    if tau is not None:
        T = oracle.se3_exp(tau) @ T
    return tensors, oracle.project(*(tensors[k] for k in FIELDS), T, camera)


@pytest.mark.parametrize("identity", [True, False])
def test_projects_as_the_oracle(device, rng, identity):
    scene = make_scene(rng, 200)
    splats = Projector(scene, device, identity=identity).forward()
    _, expected = oracle_of(scene)
    seen = splats.tile_rects.numpy()[:, 2] > 0
    assert seen.mean() > 0.5
    for name in ("means2d", "conics", "slopes", "depths", "extents"):
        value = getattr(expected, name).detach().numpy()[seen]
        np.testing.assert_allclose(getattr(splats, name).numpy()[seen], value, rtol=2e-4, atol=2e-5)
    heads = expected.features.detach().numpy()[seen, :4]
    np.testing.assert_allclose(splats.heads.numpy()[seen], heads, rtol=2e-4, atol=2e-5)
    logs = np.log(expected.conics.detach().numpy()[seen, 3])
    np.testing.assert_allclose(splats.rows.numpy()[seen, 14], logs, rtol=2e-4, atol=2e-5)


def test_tile_rects_hold_exactly_the_tiles_that_are_reached(device, rng):
    scene = make_scene(rng, 300, spread=1.2)
    rects = Projector(scene, device).forward().tile_rects.numpy()
    _, expected = oracle_of(scene)
    u, e = expected.means2d.detach().numpy(), expected.extents.numpy()
    for i in range(300):
        x = np.flatnonzero(np.abs(np.arange(CAMERA.width) - u[i, 0]) <= e[i, 0]) // 16
        y = np.flatnonzero(np.abs(np.arange(CAMERA.height) - u[i, 1]) <= e[i, 1]) // 16
        if not (expected.visible[i] and len(x) and len(y)):
            assert rects[i, 0] == rects[i, 2] or rects[i, 1] == rects[i, 3]
        else:
            assert rects[i].tolist() == [x[0], y[0], x[-1] + 1, y[-1] + 1]


def test_alpha_stays_below_a_255th_outside_the_rect(device, rng):
    scene = make_scene(rng, 50)
    splats = Projector(scene, device).forward()
    conics, means2d, rects = (getattr(splats, k).numpy() for k in ("conics", "means2d", "tile_rects"))
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    for i in np.flatnonzero(rects[:, 2]):
        dx, dy = u - means2d[i, 0], v - means2d[i, 1]
        a, b, c, o = conics[i]
        alpha = o * np.exp(-0.5 * (a * dx**2 + c * dy**2) - b * dx * dy)
        x0, y0, x1, y1 = rects[i] * 16
        alpha[y0:y1, x0:x1] = 0.0
        assert alpha.max() < 1.001 / 255.0


@pytest.mark.parametrize("spread", [0.4, 1.1], ids=["inside", "beyond the frozen Jacobian"])
def test_adjoint_agrees_with_the_oracle(device, rng, spread):
    n = 150
    scene = make_scene(rng, n, spread=spread)
    if spread > 1:
        scene["log_scales"] += 1.5
        scene["colours"] *= 3.0
    projector = Projector(scene, device)
    seen = projector.forward().tile_rects.numpy()[:, 2:3] > 0
    weights = [rng.normal(size=(n, k)) * seen for k in (2, 4, 2, 20)]
    # Conics of wide splats are small: keep all terms comparable.
    weights[2] *= 500.0
    weights[1] *= [50.0, 50.0, 50.0, 1.0]
    d_means2d = weights[0]
    actual = projector.adjoint(*weights)
    tau = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    tensors, splats = oracle_of(scene, tau=tau)
    outputs = (splats.means2d, splats.conics, splats.slopes, splats.features)
    sum((o * torch.tensor(w)).sum() for o, w in zip(outputs, weights, strict=True)).backward()
    for name, tensor in tensors.items():
        assert_gradients_agree(actual[name], tensor.grad.numpy(), name)
    assert_gradients_agree(actual["tau"], tau.grad.numpy(), "tau")
    weights = projector.weights.numpy()
    np.testing.assert_allclose(weights[seen[:, 0]], 1.0 + np.flatnonzero(seen), rtol=1e-5)
    assert (weights[~seen[:, 0]] == -1.0).all(), "left as they are"
    norms, counts = (array.numpy() for array in projector.mean2d_gradients)
    lengths = np.linalg.norm(d_means2d * [0.5 * CAMERA.width, 0.5 * CAMERA.height], axis=1)
    np.testing.assert_allclose(norms, 0.5 + np.where(seen[:, 0], lengths, 0.0), rtol=1e-4)
    np.testing.assert_array_equal(counts, np.where(seen[:, 0], 8, 7))


def test_adjoint_agrees_with_finite_differences(device, rng):
    n = 60
    scene = make_scene(rng, n, spread=0.25)
    weights = [rng.normal(size=(n, k)) for k in (2, 4, 2, 20)]
    weights[1][:, :3] *= 50.0
    weights[2] *= 500.0

    def loss(changed, T_cw=T_CW):
        splats = Projector(changed, device, T_cw=T_cw).forward()
        outputs = [a.numpy() for a in (splats.means2d, splats.conics, splats.slopes, splats.heads)]
        outputs[3] = np.concatenate([outputs[3], changed["identities"]], axis=1)
        return sum((o.astype(np.float64) * w).sum() for o, w in zip(outputs, weights, strict=True))

    gradients = Projector(scene, device).adjoint(*weights)
    for name in FIELDS:
        direction = rng.normal(size=scene[name].shape)
        h = 2e-3
        ends = [loss(scene | {name: scene[name] + s * h * direction}) for s in (1, -1)]
        assert (gradients[name] * direction).sum() == pytest.approx(
            (ends[0] - ends[1]) / (2 * h), rel=0.01
        ), name
    for k in range(6):
        h = 1e-3 * np.eye(6)[k]
        ends = [loss(scene, T_cw=se3.se3_exp(s * h) @ T_CW) for s in (1, -1)]
        scale = float(np.linalg.norm(gradients["tau"]))
        assert gradients["tau"][k] == pytest.approx((ends[0] - ends[1]) / 2e-3, abs=0.01 * scale)


def test_without_identity_or_pose_the_rest_is_the_same(device, rng):
    scene = make_scene(rng, 80)
    weights = [rng.normal(size=(80, k)) for k in (2, 4, 2, 20)]
    full = Projector(scene, device).adjoint(*weights)
    lean = Projector(scene, device, identity=False).adjoint(*weights[:3], weights[3][:, :4], pose=False)
    assert set(lean) == set(FIELDS[:5])
    for name, value in lean.items():
        np.testing.assert_array_equal(value, full[name])


def test_pose_gradient_is_reduced_over_many_blocks(device, rng):
    n = 3000
    scene = make_scene(rng, n, spread=0.25)
    weights = [rng.normal(size=(n, k)) for k in (2, 4, 2, 20)]
    weights[0] += 1.0
    tau = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    _, splats = oracle_of(scene, tau=tau)
    outputs = (splats.means2d, splats.conics, splats.slopes, splats.features)
    sum((o * torch.tensor(w)).sum() for o, w in zip(outputs, weights, strict=True)).backward()
    projector = Projector(scene, device)
    first = projector.adjoint(*weights)["tau"]
    assert_gradients_agree(first, tau.grad.numpy())
    np.testing.assert_array_equal(first, projector.adjoint(*weights)["tau"])


def degenerate_scene():
    """One sound Gaussian, then one fault a row."""
    rng = np.random.default_rng(3)
    scene = make_scene(rng, 1)
    faults = [
        ("means", lambda v: v * np.nan),
        ("means", lambda v: v + np.inf),
        ("means", lambda v: se3.inverse(T_CW)[:3, :3] @ [0, 0, -1.0] + se3.inverse(T_CW)[:3, 3]),
        ("means", lambda v: se3.inverse(T_CW)[:3, 3]),
        ("means", lambda v: se3.inverse(T_CW)[:3, :3] @ [50.0, 0, 1.0] + se3.inverse(T_CW)[:3, 3]),
        ("quats", lambda v: v * 0),
        ("quats", lambda v: v * np.nan),
        ("log_scales", lambda v: v + np.inf),
        ("log_scales", lambda v: v * np.nan),
        ("opacity_logits", lambda v: v * 0 - 6.0),
        ("opacity_logits", lambda v: v * np.nan),
        ("colours", lambda v: v * np.nan),
        ("identities", lambda v: v * np.nan),
    ]
    rows = {k: [scene[k][0]] for k in FIELDS}
    for name, fault in faults:
        for k in FIELDS:
            rows[k].append(fault(scene[k][0]) if k == name else scene[k][0])
    return {k: np.array(v) for k, v in rows.items()}


def test_faulty_gaussians_are_culled_and_harm_none(device):
    scene = degenerate_scene()
    projector = Projector(scene, device)
    rects = projector.forward().tile_rects.numpy()
    seen = (rects[:, 2] > rects[:, 0]) & (rects[:, 3] > rects[:, 1])
    assert seen.tolist() == [True] + [False] * (len(seen) - 1)
    n = len(seen)
    gradients = projector.adjoint(np.ones((n, 2)), np.ones((n, 4)), np.ones((n, 2)), np.ones((n, 20)))
    for name, value in gradients.items():
        assert np.isfinite(value).all(), name
        if name != "tau":
            assert not value[1:].any(), name


@pytest.mark.parametrize("log_scale", [-np.inf, -40.0, 8.0, 40.0], ids=["zero", "tiny", "huge", "absurd"])
def test_extreme_scales_stay_finite(device, rng, log_scale):
    scene = make_scene(rng, 4, spread=0.2)
    scene["log_scales"][:] = log_scale
    projector = Projector(scene, device)
    splats = projector.forward()
    seen = splats.tile_rects.numpy()[:, 2] > 0
    assert np.isfinite(splats.conics.numpy()[seen]).all()
    if log_scale < 0:
        assert seen.all()
        np.testing.assert_allclose(splats.conics.numpy()[:, [0, 2]], 1 / 0.3, rtol=1e-5)
    for value in projector.adjoint(
        np.ones((4, 2)), np.ones((4, 4)), np.ones((4, 2)), np.ones((4, 20))
    ).values():
        assert np.isfinite(value).all()


def test_thin_ellipses_keep_their_determinant(device):
    """Needles of 1000 px: the textbook determinant loses all digits in float32."""
    camera = Camera(60, 44, 2000.0, 2000.0, 30.0, 22.0)
    scene = make_scene(np.random.default_rng(0), 1)
    scene |= {
        "means": np.array([[0.0, 0.0, 1.0]]),
        "quats": np.array([[np.cos(0.4), 0.1, 0.2, np.sin(0.4)]]),
        "log_scales": np.log([[2.0, 1e-4, 1e-4]]),
    }
    splats = Projector(scene, device, T_cw=np.eye(4), camera=camera).forward()
    _, expected = oracle_of(scene, T_cw=np.eye(4), camera=camera)
    np.testing.assert_allclose(splats.conics.numpy()[0], expected.conics.detach().numpy()[0], rtol=1e-4)
    np.testing.assert_allclose(splats.slopes.numpy()[0], expected.slopes.detach().numpy()[0], rtol=1e-4)


@settings(max_examples=15)
@given(n=st.integers(0, 40), seed=st.integers(0, 1000))
def test_any_size(n, seed):
    scene = make_scene(np.random.default_rng(seed), n, spread=1.5)
    projector = Projector(scene, "cpu")
    gradients = projector.adjoint(np.ones((n, 2)), np.ones((n, 4)), np.ones((n, 2)), np.ones((n, 20)))
    culled = projector.splats.tile_rects.numpy()[:n, 2] == 0
    assert all(np.isfinite(v).all() for v in gradients.values())
    assert not gradients["means"][culled].any()
