# SPDX-License-Identifier: Apache-2.0
"""What a sequence is taken for, in words; that good recordings are not doubted, and odd cameras are."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ggwarp.datasets import DatasetError, open_dataset
from ggwarp.datasets.base import WithoutDepth, WithoutMasks
from ggwarp.datasets.plan.camera_checks import camera_doubts, field_of_view
from ggwarp.datasets.plan.sequence_plan import SequencePlan, plan_sequence
from ggwarp.geometry.camera import Camera

Maker = Callable[..., Path]


def plan_of(folder: Path) -> SequencePlan:
    return plan_sequence(open_dataset(str(folder), data_root=folder))


def test_a_plain_folder_in_words(make_folder: Maker, sample: SimpleNamespace) -> None:
    folder = make_folder(7)
    (folder / "traj.txt").write_text("\n".join(sample.matrix_row(sample.pose(i)) for i in range(7)))
    (folder / "notes.csv").touch()
    (folder / "depth_vis").mkdir()
    sample.save(folder / "depth_vis/0.jpg", sample.colour(0))
    for i in range(6):
        sample.save(folder / f"object_mask/{i}.png", np.full((16, 24), i + 1, np.uint8))
    plan = plan_of(folder)
    assert list(plan.lines()) == [
        "sequence: a plain folder, color/ and depth/, 7 frames",
        "pairing:  7 pairs by name",
        "camera:   fx 20 fy 20 cx 11.5 cy 7.5 of 24x16 (62 x 44 degrees), from camera.json",
        "depth:    1000 units a metre, from camera.json; median 1 m, readings at 100 % of the pixels",
        "masks:    object_mask/, 6 of 7 frames, by name; one channel; 5 ids in the frames looked at",
        "truth:    traj.txt, poses of 7 of 7 frames, camera-to-world",
        "not read: depth_vis/ (1 .jpg), notes.csv",
    ]
    assert plan.warnings == () and plan.median_depth_m == pytest.approx(1.0, abs=0.01)
    assert json.loads(json.dumps(plan.to_json()))["unread"] == ["depth_vis/ (1 .jpg)", "notes.csv"]


def test_a_replica_scene_and_a_tum_recording(make_replica: Maker, make_tum: Maker) -> None:
    replica, tum = plan_of(make_replica(4)), plan_of(make_tum([0.0, 1.0], [0.01, 1.01], [0.0, 1.0]))
    assert replica.layout == "Replica's layout, results/, 4 frames" and not replica.unread
    assert replica.pairing == "4 pairs by number" and replica.camera.endswith("from cam_params.json")
    assert tum.pairing == "2 pairs by time, at most 10.0 ms apart" and not tum.unread
    assert tum.depth.startswith(
        "5000 units a metre, assumed, as no file says (scale in camera.json does); median 0.2"
    )
    assert tum.truth == "groundtruth.txt, poses of 2 of 2 frames"


def test_what_is_left_out_is_none(make_folder: Maker) -> None:
    dataset = open_dataset(str(make_folder(3)), data_root=Path())
    plan = plan_sequence(WithoutMasks(WithoutDepth(dataset)))
    assert plan.depth == "none" and plan.masks == "none" and plan.median_depth_m is None
    assert plan.pairing and plan.layout.startswith("a plain folder")


def test_only_the_frames_that_are_used_are_looked_at(make_folder: Maker) -> None:
    dataset = open_dataset(str(make_folder(9)), data_root=Path())
    assert [f.index for f in plan_sequence(dataset, range(4, 7)).looked_at] == [4, 5, 6]


def test_depth_that_cannot_be_right_is_refused(make_folder: Maker, sample: SimpleNamespace) -> None:
    folder = make_folder(3)
    for i in range(3):
        sample.save(folder / f"depth/{i}.png", np.full((16, 24), 2, np.uint16))
    with pytest.raises(
        DatasetError, match=r"own: the median depth is 0\.002 m, as 1000 is taken for a metre"
    ):
        plan_of(folder)


def test_a_built_in_scene_is_not_rendered() -> None:
    plan = plan_sequence(open_dataset("office", data_root=Path("absent")))
    assert plan.looked_at == () and plan.layout == "a built-in scene, 120 frames" and not plan.warnings
    assert (plan.depth, plan.masks) == ("metres, rendered", "rendered")


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        (Camera(640, 480, 525.0, 525.0, 319.5, 239.5), ""),
        (Camera(640, 480, 262.0, 262.0, 159.5, 119.5), "lies far from the middle"),
        (Camera(640, 480, 100.0, 100.0, 319.5, 239.5), "the field of view is 145 degrees"),
        (Camera(640, 480, 2000.0, 2000.0, 319.5, 239.5), "the field of view is 18 degrees"),
        (Camera(640, 480, 525.0, 400.0, 319.5, 239.5), "differ by 31 %"),
    ],
)
def test_unusual_cameras_are_doubted(camera: Camera, says: str) -> None:
    doubts = list(camera_doubts(camera))
    assert any(says in doubt for doubt in doubts) if says else not doubts


def test_the_field_of_view() -> None:
    assert field_of_view(Camera(200, 100, 100.0, 50.0, 99.5, 49.5)) == pytest.approx((90.0, 90.0))


@pytest.mark.parametrize(
    "name",
    [
        "redkitchen",
        "redkitchen_200_399",
        "livingroom1",
        "desk_loop",
        "fr1/xyz",
        "rgbd_dataset_freiburg3_teddy",
        "office0_kf",
    ],
)
def test_real_recordings_are_not_doubted(recordings: Path, name: str) -> None:
    plan = plan_sequence(open_dataset(name, data_root=recordings))
    assert plan.warnings == () and plan.median_depth_m is not None and 0.3 < plan.median_depth_m < 4.0
