# SPDX-License-Identifier: Apache-2.0
"""Camera files and options of which no camera can come."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ggwarp.datasets import DatasetError, open_dataset
from ggwarp.datasets.calibration import given_camera, read_calibration
from ggwarp.datasets.folder import open_sequence
from ggwarp.io.camera import camera_fault

Maker = Callable[..., Path]
GOOD: dict[str, Any] = {"w": 24, "h": 16, "fx": 20.0, "fy": 20.0, "cx": 11.5, "cy": 7.5, "scale": 1000.0}
WORDS = json.dumps(GOOD)


def raw(key: str, text: str) -> str:
    """Return the good file with ``text`` in the place of the value of ``key``."""
    return WORDS.replace(f'"{key}": {json.dumps(GOOD[key])}', f'"{key}": {text}')


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (raw("fx", "1e-9"), "fx is 1e-09; for images 24 pixels wide"),
        (raw("fy", "1e300"), "fy is 1e"),
        (raw("fx", "1e400"), "fx is inf; it must be a finite number"),
        (raw("fx", "1" + "0" * 400), "fx is 10.*it must be a finite number"),
        (raw("fx", "1" * 5000), "a number is too long"),
        (raw("fx", "NaN"), "fx is nan"),
        (raw("fx", "true"), "fx is True"),
        (raw("cx", "24"), "its centre, cx 24"),
        (raw("cy", "-1e300"), "its centre"),
        (raw("w", "-3"), "width is -3; it must be positive"),
        (raw("h", "16.5"), "height is 16.5; it must be a whole number"),
        (raw("w", "40000"), "w is 40000; .* the images are 24x16"),
        (raw("w", "1e19"), "w is 1e"),
        (raw("w", '"a\\u001b[31m"'), r"width is 'a\\x1b\[31m'"),
        (raw("scale", "1e-300"), "depth_scale is 1e-300"),
        (raw("scale", "1e300"), "depth_scale is 1e"),
        (raw("scale", "[[[[]]]]"), r"depth_scale is \[\[\[\[\]\]\]\]"),
        (WORDS[:-1] + ', "distortion": [1e300, 0, 0, 0]}', "a coefficient is at most"),
        (WORDS[:-1] + ', "distortion": [[], 0, 0, 0]}', r"distortion is \[\]; it must be a finite"),
        (WORDS[:-1] + ', "distortion": "1234"}', "expected a list k1"),
        (WORDS[:-1] + ', "distortion": {"k1": 1}}', "expected a list k1"),
        ('{"intrinsic_matrix": [1, 2, 3, {}, 5, 6, null, 8, 9]}', "fy is 5|fx is 1|cx is None"),
        ("[" * 60_000, "nested too deeply"),
        ("[1, 2]", "is not a JSON object"),
    ],
)
def test_a_camera_file_is_refused_in_one_line(make_folder: Maker, text: str, says: str) -> None:
    folder = make_folder(1)
    (folder / "camera.json").write_text(text)
    with pytest.raises(DatasetError, match=says) as error:
        open_sequence(folder)
    message = str(error.value)
    assert "camera.json" in message and message.isprintable() and len(message) < 400 + len(str(folder))


@pytest.mark.parametrize(
    "text", ["1e9 20 11.5 7.5", "20 20 1e6 7.5", "inf 20 11.5 7.5", "20 20 11.5 7.5 1e9 0 0 0", "1 2 3 4\0"]
)
def test_text_files_pass_the_same_checks(make_folder: Maker, text: str) -> None:
    folder = make_folder(1, camera=False)
    (folder / "calibration.txt").write_text(text)
    with pytest.raises(DatasetError, match=r"calibration\.txt"):
        open_sequence(folder)


@pytest.mark.parametrize(
    "intrinsics", [(1e300, 20, 11.5, 7.5), (20, 1e-9, 11.5, 7.5), (20, 20, 24, 7.5), (float("nan"), 1, 1, 1)]
)
def test_the_option_passes_the_same_checks(intrinsics: tuple[float, float, float, float]) -> None:
    with pytest.raises(DatasetError, match=r"--intrinsics"):
        given_camera(Path("walk"), (24, 16), intrinsics)


def test_a_size_that_no_picture_has_costs_no_memory(make_folder: Maker) -> None:
    """The maps that undo the distortion are as large as the camera says."""
    folder = make_folder(1)
    camera = GOOD | {"w": 8000, "h": 8000, "distortion": [0.1, 0, 0, 0]}
    (folder / "camera.json").write_text(json.dumps(camera))
    with pytest.raises(DatasetError, match=r"0\.png: 24x16, but the camera file says 8000x8000"):
        open_sequence(folder)


def test_a_distortion_that_leaves_nothing(make_folder: Maker) -> None:
    folder = make_folder(1)
    camera = GOOD | {"distortion": [0, 0, 5000.0, 5000.0]}
    (folder / "camera.json").write_text(json.dumps(camera))
    with pytest.raises(DatasetError, match="leaves nothing of the picture"):
        open_sequence(folder)


numbers = st.floats() | st.integers() | st.sampled_from([0, 1, 24, 16, 10**400, -1e308])


@given(width=st.integers(1, 5000), height=st.integers(1, 5000), share=st.floats(0.11, 99))
def test_plausible_cameras_pass(width: int, height: int, share: float) -> None:
    focal = share * width
    assert camera_fault(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 3) is None


values = st.recursive(
    st.none() | st.booleans() | numbers | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=9) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=12,
)
keys = st.sampled_from([*GOOD, "width", "height", "camera", "distortion", "intrinsic_matrix", "depth_scale"])


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(changes=st.dictionaries(keys, values, min_size=1, max_size=3))
def test_any_json_is_a_camera_or_a_data_set_error(tmp_path: Path, changes: dict[str, Any]) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(GOOD | changes))
    try:
        calibration = read_calibration(path, depth_scale=1000.0, size=(24, 16))
    except DatasetError as error:
        assert "camera.json" in str(error) and str(error).isprintable()
    else:
        assert 0.0 < calibration.camera.fx < 1e7 and calibration.camera.width <= 16384


def test_names_that_no_system_knows(tmp_path: Path) -> None:
    for seq in ("~nobody-of-this-name/walk", "a\0b"):
        with pytest.raises(DatasetError, match="no such sequence"):
            open_dataset(seq, data_root=tmp_path)
