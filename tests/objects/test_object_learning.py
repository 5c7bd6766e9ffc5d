# SPDX-License-Identifier: Apache-2.0
"""What the objects of a map ask of its mapper: which frames vote, and which keyframes are labelled again."""

from dataclasses import replace

import numpy as np
import pytest

from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import Gaussians
from ggwarp.objects.classifier import ClassifierConfig
from ggwarp.objects.inventory import inventory
from ggwarp.objects.masks.mask_supervision import SupervisionConfig
from ggwarp.objects.object_learning import ObjectLearning
from ggwarp.types import Frame

CAMERA = Camera(6, 4, 5.0, 5.0, 2.5, 1.5)


def learning(device: str, **options) -> ObjectLearning:
    gaussians = GaussianMap(device=device, has_identity=True)
    return ObjectLearning(SupervisionConfig(**options), ClassifierConfig(), CAMERA, gaussians, seed=0)


def frame(index: int, *, mask: bool = True) -> Frame:
    return Frame(
        index=index,
        timestamp=0.0,
        rgb=np.zeros((4, 6, 3), np.uint8),
        depth=np.ones((4, 6), np.float32),
        mask=np.zeros((4, 6), np.int32) if mask else None,
    )


@pytest.mark.parametrize(
    ("interval", "expected"), [(0, [False] * 6), (1, [False] * 6), (3, [True, True, False] * 2)]
)
def test_other_frames_vote_but_every_nth(interval: int, expected: list[bool], device: str) -> None:
    objects = learning(device, vote_interval=interval)
    found = []
    for index in range(1, 7):
        found.append(objects.vote_is_due(frame(index), newest=0))
        assert not objects.vote_is_due(frame(100), newest=100), "a keyframe has voted"
        assert not objects.vote_is_due(frame(index, mask=False), newest=0)
    assert found == expected


@pytest.mark.parametrize(("interval", "expected"), [(0, [None] * 6), (2, [None, 1, None, 2, None, 0])])
def test_keyframes_are_labelled_again_in_turn(interval: int, expected: list, device: str) -> None:
    objects = learning(device, relabel_interval=interval)
    assert [objects.keyframe_to_relabel(3) for _ in range(6)] == expected


def test_without_votes_the_map_corrects_nothing(device: str) -> None:
    objects = learning(device, votes=0)
    assert not objects.vote_is_due(frame(1), newest=0) and objects.keyframe_to_relabel(3) is None


def test_the_first_keyframe_names_classes_and_seeds(device: str) -> None:
    objects = learning(device)
    mask = np.array([[0, 0, 7, 7, -1, 9]] * 4, np.int32)
    seen = Frame(0, 0.0, np.zeros((4, 6, 3), np.uint8), np.ones((4, 6), np.float32), mask)
    seeds, training = objects.supervise_keyframe(seen, np.eye(4), None)
    assert training is not None and (training.numpy() == objects.classes.encode(mask)).all()
    assert seeds.votes is not None and (seeds.votes.numpy()[:, 4] == -1).all()
    assert seeds.classes is not None and (seeds.classes.numpy() >= 0).all(), (
        "the unknown go with their neighbours"
    )
    assert len(seeds.codes) == objects.classes.count == 3
    seen_in = objects.visibility.of([1])
    assert seen_in is not None and (seen_in.first, seen_in.views) == (0, 1)
    nothing, training = objects.supervise_keyframe(frame(1, mask=False), np.eye(4), None)
    assert training is None and nothing.classes is None and nothing.votes is None


def test_an_earlier_map_s_objects_go_on(device: str) -> None:
    objects = learning(device)
    means = np.array([[x, 0.0, 1.0] for x in (0.0, 0.1, 1.0, 1.1, 2.0)], np.float32)
    n = len(means)
    earlier = Gaussians(
        means,
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.full((n, 3), -3.0, np.float32),
        np.full(n, 3.0, np.float32),
        np.zeros((n, 3), np.float32),
        object_ids=np.array([9, 9, 4, 4, 0], np.int32),
    )
    told = inventory(means, earlier.colours, earlier.object_ids, names={9: "chair"})
    told = [replace(r, label="mine", source_ids=(3, 9)) if r.id == 9 else r for r in told]
    objects._map.append(objects.adopt(earlier, told))
    ids, probabilities = objects.object_ids()
    assert ids.tolist() == [9, 9, 4, 4, 0] and (probabilities > 0.9).all()
    votes = objects._map.to_host().votes
    assert votes is not None and votes.tolist() == [8, 8, 8, 8, 0], "masks do not rename them at once"
    four, nine = objects.inventory({4: "lamp"})
    assert (nine.class_name, nine.label, nine.source_ids, nine.views) == ("chair", "mine", (3, 9), None)
    assert (four.class_name, four.label) == (None, None), "id 4 of another recording's masks is another thing"
