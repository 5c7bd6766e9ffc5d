# SPDX-License-Identifier: Apache-2.0
import dataclasses

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


def test_merged_objects_are_the_first_one(gaussians):
    merged = edits.merge(gaussians, [3, 1])
    assert set(np.unique(merged.object_ids)) == {0, 2, 3}
    was = np.isin(gaussians.object_ids, [1, 3])
    np.testing.assert_array_equal(merged.object_ids == 3, was)
    np.testing.assert_array_equal(merged.object_ids[~was], gaussians.object_ids[~was])


def _two_heaps(gaussians: Gaussians, rng, apart: float) -> Gaussians:
    """Object 2 alone: 250 Gaussians round 0 and 150 at ``apart`` along x, of which one strays far beyond."""
    means = rng.uniform(-0.5, 0.5, (400, 3)).astype(np.float32)
    means[250:, 0] += apart
    means[399] = [apart + 9.0, 0.0, 0.0]
    return dataclasses.replace(gaussians, means=means, object_ids=np.full(400, 2, np.int32))


def test_an_object_is_split_where_its_parts_are_apart(gaussians, rng):
    heaps = _two_heaps(gaussians, rng, apart=4.0)
    done, new = edits.split(heaps, 2)
    assert new == [3]
    np.testing.assert_array_equal(done.object_ids, np.where(np.arange(400) < 250, 2, 3))
    one, none = edits.split(_two_heaps(gaussians, rng, apart=1.0), 2)
    assert none == [] and set(one.object_ids) == {2}


def test_an_object_is_cut_into_as_many_parts_as_asked_for(gaussians, rng):
    touching = _two_heaps(gaussians, rng, apart=1.0)
    done, new = edits.split(touching, 2, parts=2)
    again, _ = edits.split(touching, 2, parts=2)
    np.testing.assert_array_equal(done.object_ids, again.object_ids)
    assert len(new) == 1
    larger = done.means[done.object_ids == 2]
    assert len(larger) >= len(done.means[done.object_ids == 3])
    with pytest.raises(ValueError, match="400 Gaussians make no 401 parts"):
        edits.split(touching, 2, parts=401)
