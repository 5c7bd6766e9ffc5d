# SPDX-License-Identifier: Apache-2.0
import dataclasses
import typing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ggwarp import config as c
from ggwarp.datasets.base import MaskChoice, WithoutDepth, WithoutMasks
from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.geometry.camera import Camera
from ggwarp.io.toml import write_toml
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.pipeline.tracking.tracker import TRACKERS

PRESETS = ["gg-slam", "gs-icp", "fast", "quality"]


def _camera(width: int, height: int) -> Camera:
    return Camera(width, height, 500.0, 500.0, width / 2, height / 2)


@pytest.mark.parametrize("name", PRESETS)
def test_saved_configurations_come_back(name, tmp_path):
    config = dataclasses.replace(
        c.preset_config(name), seq="a/b", data=Path("x y"), scale=0.25, frames=":9", save_renders=3
    )
    config = dataclasses.replace(config, intrinsics=(500.0, 501.5, 319.5, 239.5))
    write_toml(config, tmp_path / "config.toml")
    assert c.load_config(tmp_path / "config.toml") == config


def test_presets_differ_where_they_say():
    gg = c.preset_config("gg-slam")
    assert gg == c.RunConfig() and gg.slam.use_identity
    assert not c.preset_config("gs-icp").slam.use_identity
    fast, quality = (c.preset_config(n).slam.mapper.iterations for n in ("fast", "quality"))
    assert fast < gg.slam.mapper.iterations < quality


def test_monogs_tracks_by_rendering_and_fits_poses():
    slam = c.preset_config("monogs").slam
    assert (slam.tracker, slam.policy, slam.use_identity) == ("photometric", "covisibility", False)
    assert all(rate > 0 for rate in slam.mapper.pose_rates) and slam.mapper.isotropic_weight > 0


def test_every_preset_is_there():
    for name in typing.get_args(c.Preset):
        assert c.preset_config(name).preset == name
    with pytest.raises(c.ConfigError, match="no such preset"):
        c.preset_config("nonsense")


def test_keyframes_by_overlap_need_a_tracker_with_points():
    camera = _camera(64, 48)
    for kind in TRACKERS:
        wanted = "covisibility" if kind == "photometric" else "overlap"
        assert Slam(SlamConfig(tracker=kind), camera, camera).config.policy == wanted
    with pytest.raises(c.ConfigError, match="--policy overlap"):
        c.check(c.RunConfig(seq="x", slam=SlamConfig(tracker="photometric", policy="overlap")))


def test_untracked_masks_are_the_sequence_s_own_or_a_folder_s():
    office = SyntheticOffice(scale=0.1)
    own = c.RunConfig(masks="untracked")
    folder = c.RunConfig(masks="dir", slam=SlamConfig(masks_kind="untracked"))
    assert own.mask_choice == MaskChoice() and folder.mask_choice == MaskChoice("dir")
    with_void = c.RunConfig(masks="dir", masks_void=(255, 0))
    assert with_void.mask_choice == MaskChoice("dir", (255, 0))
    for config, kind in ((own, "untracked"), (folder, "untracked"), (c.RunConfig(masks="dir"), "tracked")):
        assert c.resolve_config(config, office).slam.masks_kind == kind


def test_what_is_left_open_is_resolved_for_a_data_set():
    office = SyntheticOffice(scale=0.1)
    used = c.resolve_config(c.RunConfig(seq="office", frames="0:45", device="cpu"), office)
    assert (used.device, used.scale, used.save_renders) == ("cpu", 1.0, 5)
    assert used.slam == SlamConfig() and c.resolve_config(used, office) == used
    given = c.resolve_config(c.RunConfig(scale=0.5, save_renders=0, device="cpu"), office)
    assert (given.scale, given.save_renders) == (0.5, 0)


def test_what_the_data_lacks_is_not_learnt():
    office = SyntheticOffice(scale=0.1)
    assert not c.resolve_config(c.RunConfig(), WithoutMasks(office)).slam.use_identity
    used = c.resolve_config(c.RunConfig(), WithoutDepth(office)).slam
    assert used.mono and used.tracker == "photometric" and not used.use_identity


def test_a_file_starts_from_its_preset(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text('preset = "gs-icp"\n[slam.mapper]\niterations = 77\n')
    config = c.load_config(path)
    assert not config.slam.use_identity and config.slam.mapper.iterations == 77


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sequence = 1", "unknown key 'sequence'"),
        ("[slam.mapper]\niteration = 1", "unknown key 'slam.mapper.iteration'"),
        ("[mapper]\niterations = 1", "unknown key 'mapper'; did you mean slam.mapper?"),
        ("scale = true", "scale = True"),
        ('preset = "mono"', "preset"),
    ],
)
def test_mistakes_in_a_file_are_named(tmp_path, text, message):
    path = tmp_path / "c.toml"
    path.write_text(text)
    with pytest.raises(c.ConfigError, match=message):
        c.load_config(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seq": None}, "--seq is missing"),
        ({"scale": 0.0}, "--scale 0"),
        ({"scale": 1.5}, "--scale 1.5"),
        ({"scale": float("nan")}, "--scale nan"),
        ({"fps": 0.0}, "--fps 0"),
        ({"fps": float("nan")}, "--fps nan"),
        ({"save_renders": -1}, "--save-renders -1"),
        ({"data": Path("/no/such/folder")}, "--data /no/such/folder: no such folder"),
        ({"frames": "5"}, "--frames 5: expected"),
        ({"frames": "a:b"}, "--frames a:b: expected"),
        ({"frames": "0:9:0"}, "STEP is 0"),
        ({"frames": "9:0:-1"}, "STEP is -1"),
        ({"frames": "1:2:3:4"}, "expected"),
    ],
)
def test_wrong_options_are_named(changes, message):
    with pytest.raises(c.ConfigError, match=message):
        c.check(dataclasses.replace(c.RunConfig(seq="x"), **changes))


def test_data_root(monkeypatch):
    monkeypatch.delenv("GGWARP_DATA", raising=False)
    assert c.RunConfig().data_root() == Path("data")
    monkeypatch.setenv("GGWARP_DATA", "/somewhere")
    assert c.RunConfig().data_root() == Path("/somewhere")
    assert c.RunConfig(data=Path("here")).data_root() == Path("here")


_end = st.one_of(st.none(), st.integers(-20, 20))


@given(begin=_end, end=_end, step=st.one_of(st.none(), st.integers(1, 5)), count=st.integers(1, 15))
def test_frames_are_a_python_slice(begin, end, step, count):
    text = ":".join("" if v is None else str(v) for v in (begin, end, step))
    expected = range(count)[begin:end:step]
    if expected:
        assert c.frame_indices(text, count) == expected
    else:
        with pytest.raises(c.ConfigError, match="no frame left"):
            c.frame_indices(text, count)
    assert c.frame_indices(None, count) == range(count)


def test_default_scale_on_a_cpu():
    assert c.image_scale(None, _camera(1200, 680), "cpu") == 0.25
    assert c.image_scale(None, _camera(640, 480), "cpu") == 0.4
    assert c.image_scale(None, _camera(160, 120), "cpu") == 1.0
    assert c.image_scale(None, _camera(1200, 680), "cuda:0") == 1.0
    assert c.image_scale(0.7, _camera(1200, 680), "cpu") == 0.7
    with pytest.raises(c.ConfigError, match="12x7 are too small"):
        c.image_scale(0.01, _camera(1200, 680), "cpu")


def test_devices():
    assert c.device_name("cpu") == "cpu"
    assert c.device_name("auto") in ("cpu", "cuda:0")
    for name in ("cuda:99", "gpu"):
        with pytest.raises(c.ConfigError, match=f"--device {name}: no such device; this machine has cpu"):
            c.device_name(name)
