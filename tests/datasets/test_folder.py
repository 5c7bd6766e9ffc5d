# SPDX-License-Identifier: Apache-2.0
"""Plain folders: spellings, camera files, poses."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ggwarp.datasets import DatasetError, FrameError, open_dataset
from ggwarp.datasets.calibration import read_calibration
from ggwarp.datasets.folder import open_sequence, recognises
from ggwarp.geometry.camera import Camera

Maker = Callable[..., Path]


@pytest.mark.parametrize("spelling", ["color", "rgb", "images"])
def test_colour_folders(make_folder: Maker, sample: SimpleNamespace, spelling: str) -> None:
    folder = make_folder(12, colour_folder=spelling)
    dataset = open_dataset(str(folder), data_root=folder)
    assert dataset.kind == "folder" and len(dataset) == 12
    frame = dataset[10]
    np.testing.assert_array_equal(frame.rgb, sample.colour(10)[..., ::-1])
    assert frame.depth is not None and frame.depth[5, 5] == np.float32(1.01) and frame.T_wc is None


def test_poses_in_one_file(make_folder: Maker, sample: SimpleNamespace) -> None:
    folder = make_folder(3)
    (folder / "traj.txt").write_text("\n".join(sample.matrix_row(sample.pose(i)) for i in range(3)))
    np.testing.assert_allclose(open_sequence(folder)[2].T_wc, sample.pose(2), atol=1e-9)


def test_poses_in_a_file_each(make_folder: Maker, sample: SimpleNamespace) -> None:
    folder = make_folder(3)
    (folder / "pose").mkdir()
    for i in (0, 2):
        np.savetxt(folder / "pose" / f"{i}.txt", sample.pose(i))
    dataset = open_sequence(folder)
    np.testing.assert_allclose(dataset[2].T_wc, sample.pose(2), atol=1e-9)
    assert dataset[1].T_wc is None


def test_a_pose_file_of_infinities_is_no_pose(make_folder: Maker, caplog: pytest.LogCaptureFixture) -> None:
    folder = make_folder(2)
    (folder / "pose").mkdir()
    np.savetxt(folder / "pose/0.txt", np.full((4, 4), -np.inf))
    np.savetxt(folder / "pose/1.txt", np.full((4, 4), np.nan))
    assert open_sequence(folder)[0].T_wc is None
    assert [r.getMessage().partition(": ")[2] for r in caplog.records] == [
        "2 of its files hold no pose (0.txt, 1.txt): frames without truth"
    ]


CAMERA = Camera(24, 16, 20.0, 21.0, 11.5, 7.5)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("camera.json", json.dumps({"width": 24, "height": 16, "fx": 20, "fy": 21, "cx": 11.5, "cy": 7.5})),
        ("camera.json", json.dumps({"fx": 20, "fy": 21, "cx": 11.5, "cy": 7.5})),
        ("cam_params.json", json.dumps({"camera": {"fx": 20, "fy": 21, "cx": 11.5, "cy": 7.5}})),
        (
            "camera_intrinsic.json",
            json.dumps({"width": 24, "height": 16, "intrinsic_matrix": [20, 0, 0, 0, 21, 0, 11.5, 7.5, 1]}),
        ),
        (
            "camera_intrinsic.json",
            json.dumps({"width": 24, "height": 16, "intrinsic_matrix": [20, 0, 11.5, 0, 21, 7.5, 0, 0, 1]}),
        ),
        ("intrinsic.json", json.dumps({"intrinsic_matrix": [[20, 0, 11.5], [0, 21, 7.5], [0, 0, 1]]})),
        ("calibration.txt", "# fx fy cx cy\n20 21 11.5 7.5\n"),
        ("calibration.txt", "20, 21, 11.5, 7.5, 0, 0, 0, 0, 0"),
        ("intrinsics.txt", "20 0 11.5\n0 21 7.5\n0 0 1\n"),
        ("intrinsics.txt", "20 0 11.5 0\n0 21 7.5 0\n0 0 1 0\n"),
        ("intrinsics.txt", "20 0 11.5 0 21 7.5 0 0 1"),
        ("intrinsics.txt", "20 0 0\n0 21 0\n11.5 7.5 1\n"),
        ("intrinsics.txt", "20 0 11.5 0\n0 21 7.5 0\n0 0 1 0\n0 0 0 1\n"),
    ],
)
def test_spellings_of_the_camera(make_folder: Maker, name: str, text: str) -> None:
    folder = make_folder(1, camera=False)
    (folder / name).write_text(text)
    assert open_sequence(folder).camera == CAMERA


@pytest.mark.parametrize("text", ["", "20 21 11.5", "20 0\n0 21"])
def test_a_camera_file_of_another_form(make_folder: Maker, text: str) -> None:
    folder = make_folder(1, camera=False)
    (folder / "intrinsics.txt").write_text(text)
    with pytest.raises(DatasetError, match=r"intrinsics\.txt: expected one line"):
        open_sequence(folder)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ({"fx": 0.5, "fy": 0.9, "cx": 0.5, "cy": 0.5}, "as of normalised intrinsics .* multiply fx and cx"),
        ({"camera_model": "OPENCV_FISHEYE"}, "camera_model 'OPENCV_FISHEYE' is not read; undistort"),
        ({"distortion_model": "equidistant"}, "distortion_model 'equidistant' is not read"),
        ({"fy": -21}, "fy is -21; it must be positive: y points down here"),
        ({"cx": 50, "cy": 40}, "lies outside the 24x16 images: are they of another size"),
    ],
)
def test_cameras_that_cannot_be_right(make_folder: Maker, text: dict, says: str) -> None:
    folder = make_folder(1)
    good = {"fx": 20, "fy": 21, "cx": 11.5, "cy": 7.5}
    (folder / "camera.json").write_text(json.dumps(good | text))
    with pytest.raises(DatasetError, match=says):
        open_sequence(folder)


def test_odd_camera_files_are_noted(make_folder: Maker) -> None:
    folder = make_folder(1, camera=False)
    (folder / "intrinsics.txt").write_text("20 0 0\n0 21 0\n11.5 7.5 1\n")
    assert "written by columns" in open_sequence(folder).source.notes[0]
    (folder / "camera.json").write_text(
        json.dumps({"fx": 20, "fy": 21, "cx": 11.5, "cy": 7.5, "camera_model": "Brand X"})
    )
    assert "camera_model 'Brand X' is not known" in open_sequence(folder).source.notes[0]


def test_a_depth_scale_beside_the_camera_counts(make_folder: Maker) -> None:
    folder = make_folder(1)
    camera = {"fx": 20, "fy": 21, "cx": 11.5, "cy": 7.5}
    (folder / "camera.json").write_text(json.dumps({"camera": camera, "scale": 5000}))
    dataset = open_sequence(folder)
    assert (
        dataset.depth_scale == 5000.0 and dataset.source.depth_unit == "5000 units a metre, from camera.json"
    )


CENTRE = {"cx": 11.5, "cy": 7.5}
ROWS = [[20, 0, 11.5], [0, 21, 7.5], [0, 0, 1]]


@pytest.mark.parametrize(
    ("values", "scale", "distortion"),
    [
        ({"fl_x": 20, "fl_y": 21, "png_depth_scale": 500, "k1": 0.1, "p2": 0.2}, 500.0, (0.1, 0, 0, 0.2)),
        ({"K": ROWS, "DepthMapFactor": 500, "k3": 0.1}, 500.0, (0, 0, 0, 0, 0.1)),
        ({"camera_matrix": sum(ROWS, []), "dist_coeffs": [0.1, 0, 0, 0]}, 1000.0, (0.1, 0, 0, 0)),  # noqa: RUF017
        ({"fx": 20, "fy": 21, "k1": 0, "k2": 0}, 1000.0, ()),
    ],
)  # fmt: skip
def test_spellings_of_other_programs(
    make_folder: Maker, values: dict, scale: float, distortion: tuple[float, ...]
) -> None:
    folder = make_folder(1)
    path = folder / "camera.json"
    path.write_text(json.dumps(CENTRE | values))
    found = read_calibration(path, depth_scale=1000.0, size=(24, 16))
    assert found.camera == CAMERA and found.depth_scale == scale and found.distortion == distortion


def test_keys_that_mean_something_and_are_not_read_are_named(make_folder: Maker) -> None:
    folder = make_folder(1)
    (folder / "camera.json").write_text(
        json.dumps({"fx": 20, "fy": 21, **CENTRE, "depth_units": 0.001, "crop": 8, "serial": "x"})
    )
    (note,) = open_sequence(folder).source.notes
    assert note == "camera.json: depth_units, crop: such keys are not read"


def test_camera_files_of_other_names_are_pointed_at(make_folder: Maker) -> None:
    folder = make_folder(1, camera=False)
    (folder / "calib.yaml").touch()
    with pytest.raises(DatasetError, match=r"no camera file .* \(calib\.yaml: such names are not read\)"):
        open_sequence(folder)


def test_intrinsics_leave_the_files_depth_scale_and_distortion(make_folder: Maker) -> None:
    folder = make_folder(1)
    camera = {"fx": 99, "fy": 21, "cx": 11.5, "cy": 7.5, "scale": 500, "distortion": [0.01, 0, 0, 0]}
    (folder / "camera.json").write_text(json.dumps(camera))
    dataset = open_sequence(folder, intrinsics=(20.0, 21.0, 11.5, 7.5))
    depth = dataset[0].depth
    assert dataset.camera == CAMERA and depth is not None and depth[5, 5] == 2.0
    assert dataset.source.camera == "--intrinsics and camera.json"
    (folder / "camera.json").unlink()
    dataset = open_sequence(folder, intrinsics=(20.0, 21.0, 11.5, 7.5))
    assert dataset.source.camera == "--intrinsics" and "assumed" in dataset.source.depth_unit


def test_no_camera_file_says_what_to_write(make_folder: Maker) -> None:
    with pytest.raises(
        DatasetError, match=r'camera\.json: no camera file in .*own; write one, such as \{"w"'
    ):
        open_sequence(make_folder(1, camera=False))


def test_colour_alone_is_a_sequence_without_depth(make_folder: Maker) -> None:
    dataset = open_sequence(make_folder(2, with_depth=False))
    assert not dataset.has_depth and dataset[0].depth is None


def test_colour_alone_needs_a_camera(make_folder: Maker) -> None:
    folder = make_folder(2, with_depth=False, camera=False)
    assert recognises(folder)
    with pytest.raises(DatasetError, match="its camera is not known"):
        open_sequence(folder)


def test_nerfstudios_depth_folder_and_any_case(make_folder: Maker) -> None:
    folder = make_folder(2)
    (folder / "depth").rename(folder / "depths")
    assert open_sequence(folder).has_depth
    (folder / "color").rename(folder / "RGB")
    (folder / "depths").rename(folder / "Depth")
    assert recognises(folder) and open_sequence(folder).source.layout == "a plain folder, RGB/ and Depth/"


def test_depth_of_a_kind_that_is_not_read_is_named(make_folder: Maker) -> None:
    folder = make_folder(2, with_depth=False)
    (folder / "depth").mkdir()
    for i in range(2):
        (folder / f"depth/{i}.raw16").touch()
    with pytest.raises(DatasetError, match=r"depth: holds 2 \.raw16, but depth is read from"):
        open_sequence(folder)


def test_names_that_are_times_are_the_frames_times(make_folder: Maker) -> None:
    folder = make_folder(3)
    for i in range(3):
        (folder / f"color/{i}.png").rename(folder / f"color/{100 + 0.5 * i:.3f}.png")
        (folder / f"depth/{i}.png").rename(folder / f"depth/{100.006 + 0.5 * i:.3f}.png")
    frame = open_sequence(folder)[2]
    assert frame.timestamp == 1.0 and frame.depth_timestamp == 1.006
    assert frame.depth is not None and frame.depth[5, 5] == np.float32(1.002)


def test_depth_in_a_folder_of_another_name_is_pointed_at(make_folder: Maker) -> None:
    folder = make_folder(2)
    (folder / "depth").rename(folder / "aligned_depth")
    dataset = open_sequence(folder)
    assert not dataset.has_depth and "aligned_depth/ (2 .png) is not read" in dataset.source.notes[0]


def test_images_of_one_name_and_two_kinds_are_refused(make_folder: Maker, sample: SimpleNamespace) -> None:
    folder = make_folder(2, with_depth=False)
    sample.save(folder / "color/1.jpg", sample.colour(1))
    with pytest.raises(DatasetError, match=r"color: 1\.jpg and 1\.png have one name; keep one kind"):
        open_sequence(folder)


def test_what_an_empty_colour_folder_holds_is_said(make_folder: Maker) -> None:
    folder = make_folder(2, with_depth=False)
    for path in (folder / "color").iterdir():
        path.rename(path.with_suffix(".heic"))
    with pytest.raises(DatasetError, match=r"no images in .*; color/ holds 2 \.heic\)"):
        open_sequence(folder)


def test_poses_of_another_number_are_told(make_folder: Maker, sample: SimpleNamespace) -> None:
    folder = make_folder(3)
    (folder / "traj.txt").write_text("\n".join(sample.matrix_row(sample.pose(i)) for i in range(5)))
    source = open_sequence(folder).source
    assert source.notes == ("traj.txt has 5 poses for 3 images; each image takes the line of its number",)


def test_depth_of_other_names(make_folder: Maker) -> None:
    folder = make_folder(1)
    (folder / "depth/0.png").rename(folder / "depth/a.png")
    with pytest.raises(DatasetError, match="the names do not tell which depth images belong to which colour"):
        open_sequence(folder)


def test_an_empty_folder(tmp_path: Path) -> None:
    (tmp_path / "color").mkdir()
    (tmp_path / "depth").mkdir()
    with pytest.raises(DatasetError, match="the sequence is empty"):
        open_sequence(tmp_path)


def test_coloured_depth_is_refused(make_folder: Maker, sample: SimpleNamespace) -> None:
    folder = make_folder(3)
    sample.save(folder / "depth/1.png", sample.colour(1))
    with pytest.raises(FrameError, match=r"1\.png: 3 channel\(s\) of uint8; depth must be one channel"):
        open_sequence(folder)[1]


def test_a_saturated_reading_is_none(make_folder: Maker, sample: SimpleNamespace) -> None:
    folder = make_folder(1)
    depth = sample.depth(0)
    depth[3, 4] = 65535
    sample.save(folder / "depth/0.png", depth)
    read = open_sequence(folder)[0].depth
    assert read is not None and read[3, 4] == 0.0 and read[3, 5] == 1.0
