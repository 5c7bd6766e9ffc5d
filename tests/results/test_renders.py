# SPDX-License-Identifier: Apache-2.0
import shutil
from pathlib import Path

import cv2
import numpy as np

from ggwarp.results import renders
from ggwarp.types import Rendered


def _read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def test_renders(rng, tmp_path):
    shape = (6, 8)
    objects = np.zeros(shape, np.int32)
    objects[0, 0] = 300
    identity = rng.normal(size=(*shape, 16)).astype(np.float32)
    view = Rendered(
        rgb=np.broadcast_to(np.float32([1.0, 0.5, 0.0]), (*shape, 3)),
        depth=np.full(shape, 1.2345, np.float32),
        median_depth=np.full(shape, 1.2345, np.float32),
        opacity=np.ones(shape, np.float32),
        identity=identity,
        objects=objects,
    )
    writer = renders.RenderWriter(tmp_path / "renders", identity.reshape(-1, 16))
    writer.write(42, view)
    files = {p.name for p in (tmp_path / "renders").iterdir()}
    assert files == {f"frame000042_{w}.png" for w in ("rgb", "depth", "objects", "features")}
    assert _read(tmp_path / "renders/frame000042_rgb.png")[0, 0].tolist() == [0, 128, 255]  # BGR
    depth = _read(tmp_path / "renders/frame000042_depth.png")
    assert depth.dtype == np.uint16 and np.isin(depth, (1234, 1235)).all()
    ids = _read(tmp_path / "renders/frame000042_objects.png")
    assert ids.dtype == np.uint16 and ids[0, 0] == 300 and ids.sum() == 300


def test_pictures_make_room_the_newest_first(tmp_path, monkeypatch):
    grey = np.full((6, 8), 0.5, np.float32)
    view = Rendered(rgb=np.stack([grey] * 3, -1), depth=grey, median_depth=grey, opacity=grey)
    folder = tmp_path / "renders"
    writer = renders.RenderWriter(folder, None)
    for index in range(4):
        writer.write(index, view)

    def free_of(folder: Path) -> shutil._ntuple_diskusage:
        return shutil._ntuple_diskusage(1000, 0, 1000 - 100 * len(list(folder.iterdir())))

    monkeypatch.setattr(shutil, "disk_usage", free_of)
    writer.make_room(0)
    assert {p.name[:11] for p in folder.iterdir()} == {"frame000000", "frame000001", "frame000002"}
    writer.make_room(700)
    assert {p.name[:11] for p in folder.iterdir()} == {"frame000000"}
    writer.make_room(2000)
    assert not folder.exists(), "what holds nothing goes, too"


def test_depth_that_has_no_place_in_16_bits():
    depth = np.array([[np.nan, np.inf, -1.0, 70.0, 0.001]], np.float32)
    assert renders.depth_to_millimetres(depth).tolist() == [[0, 0, 0, 65535, 1]]


def test_feature_colours_do_not_depend_on_the_eigenvectors_sign(rng):
    identities = rng.normal(size=(500, 16)).astype(np.float32) * np.linspace(2, 0.1, 16, dtype=np.float32)
    mean, axes = renders.feature_basis(identities)
    shuffled_mean, shuffled_axes = renders.feature_basis(identities[rng.permutation(500)])
    np.testing.assert_allclose(mean, shuffled_mean, atol=1e-5)
    np.testing.assert_allclose(axes, shuffled_axes, atol=1e-4)
    image = renders.feature_image(identities.reshape(20, 25, 16), (mean, axes))
    assert image.shape == (20, 25, 3) and image.std() > 30
