# SPDX-License-Identifier: Apache-2.0
"""What a map learns from masks, seen from outside: good ones, bad ones and none."""

import dataclasses

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.geometry import se3
from ggwarp.objects.masks.id_splitting import SplittingConfig
from ggwarp.objects.masks.mask_supervision import SupervisionConfig
from ggwarp.pipeline.mapping.build import build_mapper
from ggwarp.pipeline.mapping.mapper import Mapper, MapperConfig
from ggwarp.types import Frame

OFFICE = SyntheticOffice(scale=0.1)


@pytest.fixture(scope="module")
def frame() -> Frame:
    return OFFICE[0]


def mapped(device: str, frame: Frame, masks: list, **options) -> Mapper:
    """Return a map that saw ``frame`` once with each of ``masks``; only votes move its identities."""
    classifier = dataclasses.replace(MapperConfig().classifier, weight=0.0, weight_3d=0.0)
    config = MapperConfig(classifier=classifier, supervision=SupervisionConfig(**options))
    mapper = build_mapper(config, OFFICE.camera, device=device, use_identity=True)
    for index, mask in enumerate(masks):
        assert frame.T_wc is not None
        mapper.insert(dataclasses.replace(frame, index=index, mask=mask), frame.T_wc)
        for _ in range(8):
            mapper.iterate()
    return mapper


def agreement(mapper: Mapper, frame: Frame, where: np.ndarray | None = None) -> float:
    """Return the share of Gaussians that belong to the object at whose pixels (``where``) they lie."""
    assert frame.T_wc is not None and frame.mask is not None
    points = se3.transform_points(se3.inverse(frame.T_wc), mapper.map.to_host().means)
    c = OFFICE.camera
    columns = np.rint(points[:, 0] / points[:, 2] * c.fx + c.cx).astype(int)
    rows = np.rint(points[:, 1] / points[:, 2] * c.fy + c.cy).astype(int)
    right = next(mapper.parts()).object_ids == frame.mask[rows, columns]
    return float(right.mean() if where is None else right[where[rows, columns]].mean())


def renamed(mask: np.ndarray, old: int, new: int) -> np.ndarray:
    return np.where(mask == old, new, mask).astype(np.int32)


def largest(mask: np.ndarray) -> list[int]:
    ids, counts = np.unique(mask, return_counts=True)
    return ids[np.argsort(-counts)][:3].tolist()


def test_dots_are_outvoted(device: str, frame: Frame, rng: np.random.Generator) -> None:
    def dotted() -> np.ndarray:
        dots = rng.random(frame.mask.shape) < 0.3
        return np.where(dots, rng.integers(0, 50, frame.mask.shape), frame.mask).astype(np.int32)

    masks = [dotted() for _ in range(7)]
    assert agreement(mapped(device, frame, masks), frame) > 0.88
    assert agreement(mapped(device, frame, masks, votes=0), frame) < 0.75


def test_an_early_mistake_is_put_right_by_later_frames(device: str, frame: Frame) -> None:
    first, second, _ = largest(frame.mask)
    wrong = renamed(frame.mask, first, second)
    here = frame.mask == first
    assert agreement(mapped(device, frame, [wrong]), frame, here) == 0.0
    assert agreement(mapped(device, frame, [wrong] + 4 * [frame.mask]), frame, here) > 0.98


def test_a_swapped_frame_is_seen_through(device: str, frame: Frame) -> None:
    first, second, _ = largest(frame.mask)
    swapped = renamed(frame.mask, first, second)
    mapper, straight = (mapped(device, frame, 3 * [frame.mask] + [last]) for last in (swapped, frame.mask))
    # The last vote went to the object's own code: identities are where they would be without the swap.
    one, other = (m.map.fields["identities"].numpy()[: m.map.count] for m in (mapper, straight))
    same = np.abs(one - other).max(axis=1) < 1e-3
    assert same.mean() > 0.95
    assert agreement(mapper, frame, frame.mask == first) > 0.95


@pytest.mark.parametrize("relabel_interval", [0, 1])
def test_a_keyframe_s_early_mistake_is_taken_back(relabel_interval: int, device: str, frame: Frame) -> None:
    """What a keyframe should look like is seen anew once other frames have outvoted it."""
    assert frame.mask is not None and frame.T_wc is not None
    first, second = largest(frame.mask)[:2]
    swapped = np.select([frame.mask == first, frame.mask == second], [second, first], frame.mask)
    mapper = mapped(
        device, frame, [swapped, *[frame.mask] * 5], vote_interval=0, relabel_interval=relabel_interval
    )
    keyframe = mapper._keyframes[0]
    right = mapper.objects.classes.encode(frame.mask)
    where = (frame.mask == first) | (frame.mask == second)
    assert (keyframe.labels.numpy()[where] != right[where]).all()
    for index in range(1000, 1006):
        mapper.observe_frame(dataclasses.replace(frame, index=index), frame.T_wc)
    labels = mapper._keyframes[0].labels.numpy()
    wrong = where & (labels >= 0) & (labels != right)
    assert wrong.sum() < 0.1 * where.sum() if relabel_interval else wrong.sum() == where.sum()
    assert (labels[~where] == right[~where]).mean() > 0.9


@pytest.mark.parametrize("vote_interval", [0, 5])
def test_frames_that_are_no_keyframes_vote(vote_interval: int, device: str, frame: Frame) -> None:
    assert frame.mask is not None and frame.T_wc is not None
    target = largest(frame.mask)[0]
    wrong = renamed(frame.mask, target, int(frame.mask.max()) + 1)
    mapper = mapped(device, frame, [wrong], vote_interval=vote_interval, relabel_interval=0)
    for index in range(1000, 1010):
        mapper.observe_frame(dataclasses.replace(frame, index=index), frame.T_wc)
    share = agreement(mapper, frame, frame.mask == target)
    assert share > 0.9 if vote_interval else share == 0.0
    assert len(mapper.objects.voting_indices) == (8 if vote_interval else 0), "one in five is held out"
    before = mapper.map.fields["votes"].numpy().copy()
    mapper.observe_frame(dataclasses.replace(frame, index=2000), frame.T_wc, skip_objects=True)
    np.testing.assert_array_equal(mapper.map.fields["votes"].numpy(), before)


def test_frames_without_mask_learn_from_the_map(device: str, frame: Frame) -> None:
    mapper = mapped(device, frame, [frame.mask, None])
    votes = mapper.map.fields["votes"].numpy()[: mapper.map.count]
    assert (votes == 1).any() and (votes == 0).any(), "what began without a mask has no vote"
    assert agreement(mapper, frame) > 0.95
    assert agreement(mapped(device, frame, [None]), frame) < 0.1
    assert agreement(mapped(device, frame, [None, frame.mask]), frame) > 0.98


def test_contradictions_are_not_learnt(device: str, frame: Frame) -> None:
    mapper = mapped(device, frame, 3 * [frame.mask])
    first, second, _ = largest(frame.mask)
    spoilt = frame.mask.copy()
    here = np.zeros(spoilt.shape, bool)
    here[::7, ::7] = True
    here &= spoilt == first
    spoilt[here] = second
    mapper.render(frame.T_wc)
    seen = dataclasses.replace(frame, index=3, mask=spoilt)
    seeds, training = mapper.objects.supervise_keyframe(seen, frame.T_wc, mapper._renderer)
    assert training is not None and seeds.classes is not None
    training = training.numpy()
    assert (training[here] == -1).mean() > 0.8
    assert (training[~here] >= 0).mean() > 0.95
    assert (seeds.classes.numpy() >= 0).all()


def test_twice_the_same_to_the_bit(device: str, frame: Frame) -> None:
    masks = [frame.mask, renamed(frame.mask, *largest(frame.mask)[:2]), None, frame.mask]
    one, two = (mapped(device, frame, masks).map.to_host().arrays() for _ in range(2))
    for name, values in one.items():
        np.testing.assert_array_equal(values, two[name])


def test_ids_shuffled_in_every_frame_are_the_same_objects(device: str, rng: np.random.Generator) -> None:
    """Two neighbouring frames, three times, with new ids each time: each object is found again."""
    mapper = build_mapper(
        MapperConfig(), OFFICE.camera, device=device, use_identity=True, tracked_masks=False
    )
    frames = [OFFICE[i] for i in (0, 2, 0, 2, 0, 2)]
    for frame in frames:
        names = rng.permutation(200)[: frame.mask.max() + 1].astype(np.int32) + 1
        assert frame.T_wc is not None
        mapper.insert(dataclasses.replace(frame, mask=names[frame.mask]), frame.T_wc)
        for _ in range(8):
            mapper.iterate()
    view, mask = mapper.render(frames[0].T_wc), frames[0].mask
    ids, counts = np.unique(mask, return_counts=True)
    for true in ids[counts > 60]:
        found, pixels = np.unique(view.objects[mask == true], return_counts=True)
        assert pixels.max() > 0.7 * pixels.sum() and found[pixels.argmax()] > 0
    found = np.unique(view.objects)
    assert found.max() <= mapper.objects.classes.count and len(found) - 1 <= 1.2 * len(ids)
    assert {r.id for r in mapper.objects.inventory({})} <= set(mapper.objects.classes.ids.tolist())


def test_an_object_revived_under_another_id_stays_one(device: str, frame: Frame) -> None:
    first, _, _ = largest(frame.mask)
    revived = renamed(frame.mask, first, 777)
    mapper = mapped(device, frame, 3 * [frame.mask] + 3 * [revived])
    view = mapper.render(frame.T_wc)
    assert 777 not in view.objects and 777 not in next(mapper.parts()).object_ids
    record = next(r for r in mapper.objects.inventory({}) if r.id == first)
    assert record.source_ids == (first, 777)


@pytest.mark.parametrize("views", [0, 3])
def test_an_id_given_to_two_objects_far_apart_is_split(views: int, device: str) -> None:
    frames = [OFFICE[0], OFFICE[len(OFFICE) // 2]]
    ids = [set(largest(f.mask)) for f in frames]
    one = next(i for i in largest(frames[0].mask) if i not in frames[1].mask)
    other = next(i for i in largest(frames[1].mask) if i not in frames[0].mask)
    assert one in ids[0] and other in ids[1]
    frames[1] = dataclasses.replace(frames[1], mask=renamed(frames[1].mask, other, one))
    config = MapperConfig(supervision=SupervisionConfig(splitting=SplittingConfig(views=views)))
    mapper = build_mapper(config, OFFICE.camera, device=device, use_identity=True)
    for frame in 4 * frames:
        assert frame.T_wc is not None
        mapper.insert(frame, frame.T_wc)
        for _ in range(8):
            mapper.iterate()
    shown = [mapper.render(f.T_wc).objects[f.mask == one] for f in frames]
    names = [int(np.bincount(v).argmax()) for v in shown]
    assert names[0] == one and (names[1] != one) == bool(views)
    assert all((v == name).mean() > 0.8 for v, name in zip(shown, names, strict=True))
    records = {r.id: r for r in mapper.objects.inventory({one: "one", other: "other", names[1]: "same"})}
    if views:
        assert records[names[1]].source_ids == (one,)
        assert records[names[1]].class_name is None, "the data's name of that number is another object's"
