# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ggwarp.editing import edits
from ggwarp.geometry import se3
from ggwarp.map.gaussians import SH_C0, Gaussians, join
from ggwarp.objects.inventory import inventory


@pytest.fixture
def gaussians(rng) -> Gaussians:
    n = 400
    quats = rng.normal(size=(n, 4))
    return Gaussians(
        rng.uniform(-3, 3, (n, 3)).astype(np.float32),
        (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        rng.normal(-4, 0.5, (n, 3)).astype(np.float32),
        rng.normal(size=n).astype(np.float32),
        rng.normal(0, 0.5, (n, 3)).astype(np.float32),
        rng.integers(0, 4, n).astype(np.int32),
        rng.normal(size=(n, 16)).astype(np.float32),
        rng.integers(0, 9, n).astype(np.int32),
        rng.integers(0, 9, n).astype(np.int32),
    )


def _covariances(gaussians: Gaussians) -> np.ndarray:
    R = Rotation.from_quat(gaussians.quats[:, [1, 2, 3, 0]]).as_matrix()
    return np.einsum("nij,nj,nkj->nik", R, np.exp(2.0 * gaussians.log_scales.astype(float)), R)


def test_move_and_move_back_give_the_same_map(gaussians, rng):
    for _ in range(5):
        chosen = gaussians.object_ids == 2
        R = se3.so3_exp(rng.normal(size=3))
        T = edits.motion_about(rng.normal(size=3), rotation=R, translation=rng.normal(size=3))
        moved = edits.move(gaussians, chosen, T)
        back = edits.move(moved, chosen, se3.inverse(T))
        assert np.abs(moved.means - gaussians.means)[chosen].max() > 0.1
        for name, before in gaussians.arrays().items():
            np.testing.assert_allclose(getattr(back, name), before, rtol=0, atol=1e-6, err_msg=name)
            np.testing.assert_array_equal(getattr(back, name)[~chosen], before[~chosen])


def test_shapes_move_along(gaussians):
    chosen = gaussians.object_ids == 1
    R = se3.so3_exp([0.4, -1.0, 0.7])
    T = edits.motion_about([1.0, 2.0, 3.0], rotation=R, translation=[0.0, 0.5, 0.0])
    moved = edits.move(gaussians, chosen, T)
    before, after = _covariances(gaussians), _covariances(moved)
    np.testing.assert_allclose(after[chosen], R @ before[chosen] @ R.T, rtol=1e-4, atol=1e-7)
    expected = (gaussians.means[chosen] - [1, 2, 3]) @ R.T + [1, 2.5, 3]
    np.testing.assert_allclose(moved.means[chosen], expected, atol=1e-5)


def test_extract_and_remove_share_the_map_out(gaussians):
    chosen = gaussians.object_ids == 3
    whole = join(edits.extract(gaussians, chosen), edits.remove(gaussians, chosen))
    order = np.concatenate([np.nonzero(chosen)[0], np.nonzero(~chosen)[0]])
    for name, before in gaussians.arrays().items():
        np.testing.assert_array_equal(getattr(whole, name), before[order])


def test_maps_of_different_kinds_are_not_joined(gaussians):
    plain = Gaussians(*list(vars(gaussians).values())[:5])
    with pytest.raises(ValueError, match="object_ids"):
        join(gaussians, plain)


def test_recolour_keeps_light_and_shade(gaussians):
    chosen = gaussians.object_ids == 2
    painted = edits.recolour(gaussians, chosen, (200, 100, 0))
    shown = 0.5 + SH_C0 * painted.colours[chosen]
    np.testing.assert_array_equal(painted.colours[~chosen], gaussians.colours[~chosen])
    unclipped = shown[:, 0] < 0.999
    np.testing.assert_allclose(shown[unclipped, 1], 0.5 * shown[unclipped, 0], atol=1e-5)
    np.testing.assert_allclose(shown[:, 2], 0.0, atol=1e-6)
    brightness = np.clip(0.5 + SH_C0 * gaussians.colours[chosen], 0, 1) @ [0.299, 0.587, 0.114]
    assert np.corrcoef(brightness, shown[:, 1])[0, 1] > 0.999
    assert shown[:, 1].mean() == pytest.approx(100 / 255, abs=0.01)


def test_nothing_selected_changes_nothing(gaussians):
    none = np.zeros(len(gaussians), bool)
    for edited in (
        edits.remove(gaussians, none),
        edits.move(gaussians, none, np.eye(4)),
        edits.recolour(gaussians, none, (1, 2, 3)),
    ):
        for name, before in gaussians.arrays().items():
            np.testing.assert_array_equal(getattr(edited, name), before)
    assert len(edits.extract(gaussians, none)) == 0


def test_labels():
    means = np.zeros((2, 3), np.float32)
    records = inventory(means, means, np.array([4, 9]), names={4: "mug"})
    named = edits.relabel(records, 4, "Anna's mug")
    assert [r.name for r in named] == ["Anna's mug", "object 9"]
    assert [r.name for r in edits.relabel(named, 4, "")] == ["mug", "object 9"]
