# SPDX-License-Identifier: Apache-2.0
import pytest

from ggwarp.geometry.camera import Camera
from ggwarp.io.camera import read_camera, write_camera


def test_a_camera_comes_back(tmp_path):
    camera = Camera(1200, 680, 600.0, 601.5, 599.5, 339.5).scaled(0.25)
    write_camera(tmp_path / "camera.json", camera)
    assert read_camera(tmp_path / "camera.json") == camera


@pytest.mark.parametrize(
    "text",
    ["", "[1]", '{"w": 3}', '{"w": 3, "h": 0, "fx": 1, "fy": 1, "cx": 1, "cy": 1}', '{"w": "x", "h": 2}'],
)
def test_what_is_no_camera_is_refused(tmp_path, text):
    path = tmp_path / "camera.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"camera\.json"):
        read_camera(path)


def test_a_data_set_reads_it_too(tmp_path):
    from ggwarp.datasets.calibration import read_calibration

    camera = Camera(64, 48, 50.0, 51.0, 31.5, 23.25)
    write_camera(tmp_path / "camera.json", camera)
    calibration = read_calibration(tmp_path / "camera.json", depth_scale=1.0, size=(1, 1))
    assert calibration.camera == camera and calibration.depth_scale == 1000.0
