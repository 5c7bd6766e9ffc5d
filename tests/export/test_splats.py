# SPDX-License-Identifier: Apache-2.0
"""Splats as others read them: what comes back renders the same picture, upright."""

from __future__ import annotations

import gzip
import importlib
import json
import struct
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggwarp.editing.map_view import MapView
from ggwarp.export.__main__ import main
from ggwarp.geometry.upright import rotation_to
from ggwarp.io.ply import read_ply
from ggwarp.map.gaussians import Gaussians
from small_run import CAMERA, decibels, read_accessor, read_glb

UP, AHEAD = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def export(run_folder: Path, *options: str) -> int:
    return main([str(run_folder), "--up", "-y", *options])


def written(run_folder: Path, kind: str, name: str, *options: str) -> Path:
    assert export(run_folder, "--to", kind, *options) == 0
    return run_folder / "export" / name


def assert_same_picture(back: Gaussians, scene: Gaussians, convention: str, least: float = 40.0) -> None:
    """The camera turns as the map did."""
    T_wc, turned = np.eye(4), np.eye(4)
    turned[:3, :3] = rotation_to(convention, UP, AHEAD)
    one = MapView(scene, CAMERA).render(T_wc).rgb
    other = MapView(back, CAMERA).render(turned).rgb
    assert decibels(one, other) >= least
    assert decibels(one, MapView(back, CAMERA).render(np.diag([1.0, -1.0, -1.0, 1.0]) @ turned).rgb) < 30.0


def gaussians(means, quats, log_scales, opacity_logits, colours, ids=None) -> Gaussians:
    arrays = [
        np.ascontiguousarray(a, np.float32) for a in (means, quats, log_scales, opacity_logits, colours)
    ]
    return Gaussians(*arrays, ids)


@pytest.mark.parametrize("degree", [0, 3])
def test_ply_is_a_table_of_floats_for_readers_that_ask_no_types(run_folder: Path, scene, degree: int) -> None:
    """As the reference loader does it: names by their beginnings, every property four bytes."""
    path = written(run_folder, "ply", "map.ply", "--sh-degree", str(degree))
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    names = [line.split()[-1] for line in lines if line.startswith("property")]
    assert all(line.split()[1] == "float" for line in lines if line.startswith("property"))
    table = np.frombuffer(body, "<f4").reshape(len(scene), len(names))
    rest = [name for name in names if name.startswith("f_rest_")]
    assert len(rest) == 3 * (degree + 1) ** 2 - 3 and not table[:, [names.index(n) for n in rest]].any()
    column = {name: table[:, names.index(name)] for name in names}
    back = gaussians(
        np.stack([column[n] for n in "xyz"], 1),
        np.stack([column[n] for n in sorted(n for n in names if n.startswith("rot"))], 1),
        np.stack([column[n] for n in sorted(n for n in names if n.startswith("scale_"))], 1),
        column["opacity"],
        np.stack([column[f"f_dc_{i}"] for i in range(3)], 1),
    )
    assert_same_picture(back, scene, "y-down")
    assert np.array_equal(column["object_id"], scene.object_ids)


def test_gsply_reads_ply(run_folder: Path, scene) -> None:
    gsply = pytest.importorskip("gsply")
    back = gsply.plyread(written(run_folder, "ply", "map.ply", "--sh-degree", "3"))
    assert_same_picture(
        gaussians(back.means, back.quats, back.scales, back.opacities, back.sh0), scene, "y-down"
    )
    own = gsply.plyread(run_folder / "map.ply")  # a run's own map, with identities
    assert np.array_equal(own.means, scene.means) and np.array_equal(own.sh0, scene.colours)


def test_gaussforge_reads_ply(run_folder: Path, scene) -> None:
    forge = pytest.importorskip("gaussforge").GaussForge()
    data = written(run_folder, "ply", "map.ply").read_bytes()
    info = forge.get_model_info(data, "ply")
    assert "error" not in info and info["data"]["basic"]["numPoints"] == len(scene)


def test_gltf_holds_what_khronos_extension_says(run_folder: Path, scene) -> None:
    document, binary = read_glb(written(run_folder, "gltf", "map.splats.glb"))
    (primitive,) = document["meshes"][0]["primitives"]
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"] and primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    a = {k.split(":")[-1]: read_accessor(document, binary, v) for k, v in primitive["attributes"].items()}
    opacity = a["OPACITY"].astype(float)
    back = gaussians(
        a["POSITION"], np.roll(a["ROTATION"], 1, axis=1), np.log(a["SCALE"]),
        np.log(opacity / (1.0 - opacity))[:, 0], a["SH_DEGREE_0_COEF_0"],
    )  # fmt: skip
    assert_same_picture(back, scene, "y-up")
    assert np.array_equal(a["_OBJECT_ID"][:, 0], scene.object_ids)


def test_usd_reads_its_own_schema(run_folder: Path, scene) -> None:
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdVol

    stage = Usd.Stage.Open(str(written(run_folder, "usd", "map.usdc")))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    value = {name: splats.GetPrim().GetAttribute(name).Get() for name in splats.GetPrim().GetPropertyNames()}
    quats = np.array([[q.real, *q.imaginary] for q in value["orientations"]])
    opacity = np.array(value["opacities"], float)
    coefficients = np.array(value["radiance:sphericalHarmonicsCoefficients"])
    back = gaussians(
        np.array(value["positions"]), quats, np.log(np.array(value["scales"])),
        np.log(opacity / (1.0 - opacity)), coefficients,
    )  # fmt: skip
    assert value["radiance:sphericalHarmonicsDegree"] == 0
    assert_same_picture(back, scene, "y-up")
    assert np.array_equal(value["primvars:objectId"], scene.object_ids)
    assert splats.GetPrim().GetCustomDataByKey("objectNames")["5"] == "cube"


def read_spz(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, opacities and log scales, by Niantic's description of version 2 and 3."""
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, _, _ = struct.unpack_from("<IIIBBBB", data)
    assert magic == 0x5053474E and version in (2, 3) and degree == 0
    fixed = np.frombuffer(data, np.uint8, 9 * count, 16).reshape(-1, 3, 3).astype(np.int32)
    whole = fixed[..., 0] | fixed[..., 1] << 8 | fixed[..., 2] << 16
    means = np.where(whole & 0x800000, whole - (1 << 24), whole) / (1 << bits)
    alphas = np.frombuffer(data, np.uint8, count, 16 + 9 * count) / 255.0
    scales = np.frombuffer(data, np.uint8, 3 * count, 16 + 13 * count).reshape(-1, 3) / 16.0 - 10.0
    return means, alphas, scales


def test_spz_as_niantic_describes_it(run_folder: Path, scene) -> None:
    pytest.importorskip("gaussforge")
    means, alphas, scales = read_spz(written(run_folder, "spz", "map.spz"))
    assert np.allclose(means @ rotation_to("y-up", UP, AHEAD), scene.means, atol=1e-3)
    assert np.allclose(alphas, 1.0 / (1.0 + np.exp(-scene.opacity_logits)), atol=0.01)
    assert np.allclose(scales, scene.log_scales, atol=0.04)


def test_gsply_reads_spz_for_the_same_picture(run_folder: Path, scene) -> None:
    pytest.importorskip("gaussforge")
    gsply = pytest.importorskip("gsply")
    back = gsply.read_spz(written(run_folder, "spz", "map.spz"))
    back = gaussians(back.means, back.quats, back.scales, back.opacities, back.sh0)
    assert_same_picture(back, scene, "y-up", least=35.0)


def test_sog_as_playcanvas_describes_it(run_folder: Path, scene) -> None:
    """Splats are in an order of their own: the clouds are compared."""
    pytest.importorskip("gaussforge")
    with zipfile.ZipFile(written(run_folder, "sog", "map.sog")) as archive:
        meta = json.loads(archive.read("meta.json"))
        low, high = (
            cv2.imdecode(np.frombuffer(archive.read(name), np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)
            for name in meta["means"]["files"]
        )
    least, most = (np.array(meta["means"][key]) for key in ("mins", "maxs"))
    packed = least + (high << 8 | low).reshape(-1, 3)[: len(scene)] / 65535.0 * (most - least)
    means = np.sign(packed) * np.expm1(np.abs(packed))
    from scipy.spatial import KDTree

    distances, rows = KDTree(means).query(scene.means)
    assert distances.max() < 1e-3 and len(set(rows)) == len(np.unique(scene.means, axis=0))


def test_splat_is_rows_of_32_bytes(run_folder: Path, scene) -> None:
    pytest.importorskip("gaussforge")
    data = written(run_folder, "splat", "map.splat").read_bytes()
    row = [("at", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)]
    table = np.frombuffer(data, np.dtype(row))
    order = np.lexsort(table["at"].T)
    expected = np.lexsort(scene.means.T)
    assert np.allclose(table["at"][order], scene.means[expected])
    assert np.allclose(np.log(table["scale"][order]), scene.log_scales[expected], atol=1e-3)


def test_compressed_ply_is_read_by_gsply(run_folder: Path, scene) -> None:
    pytest.importorskip("gaussforge")
    gsply = pytest.importorskip("gsply")
    back = gsply.plyread(written(run_folder, "compressed-ply", "map.compressed.ply"))
    assert len(back.means) == len(scene)
    assert np.abs(np.sort(back.means, axis=0) - np.sort(scene.means, axis=0)).max() < 5e-3


def test_points_have_colours_and_objects(run_folder: Path, scene) -> None:
    trimesh = pytest.importorskip("trimesh")
    path = written(run_folder, "points", "map.points.ply")
    cloud, opaque = trimesh.load(path), scene.opacity_logits > 0.0
    assert np.allclose(cloud.vertices @ rotation_to("z-up", UP, AHEAD), scene.means[opaque], atol=1e-5)
    red = cloud.colors[scene.object_ids[opaque] == 5]
    assert (np.abs(red[:, :3].astype(int) - [230, 26, 26]) <= 1).all()


def test_one_object_alone_and_in_the_worlds_own_axes(run_folder: Path, scene) -> None:
    path = written(run_folder, "ply", "5.ply", "--objects", "5", "--axes", "world")
    alone = read_ply(path)
    own = scene.means[scene.object_ids == 5]
    assert len(alone) == len(own) and np.allclose(np.sort(alone.means, 0), np.sort(own, 0), atol=1e-6)
    assert alone.object_ids is not None and set(alone.object_ids.tolist()) == {5}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--to", "gtlf"], "did you mean gltf?"),
        (["--to", "ply", "--objects", "lamp"], "no such object"),
        (["--to", "ply", "--up", "0,0,0"], "--up"),
        (["--to", "colmap"], "--rendered has the map's pictures instead"),
        (["--to", "ply", "--every", "0"], "--every 0"),
        (["--to", "mesh", "--voxel", "0.00001"], "--voxel 1e-05"),
        (["--to", "ply", "--device", "cuda:77"], None),
    ],
)
def test_what_cannot_be_done_is_one_line(
    run_folder: Path, options: list[str], said: str | None, capsys
) -> None:
    code = export(run_folder, *options)
    if said is None:  # nothing is rendered for it
        assert code == 0
        return
    (line,) = capsys.readouterr().err.splitlines()
    assert code == 2 and said in line and not list(run_folder.glob("export/*"))


def test_nothing_is_overwritten(run_folder: Path, capsys) -> None:
    written(run_folder, "ply", "map.ply")
    assert export(run_folder, "--to", "points,ply") == 2
    assert "exists already" in capsys.readouterr().err
    assert not (run_folder / "export" / "map.points.ply").exists()


def test_a_missing_library_is_named_with_its_remedy(run_folder: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    for kind, extra in (("spz", "export"), ("usd", "export"), ("rrd", "rerun")):
        assert export(run_folder, "--to", kind) == 2
        assert f"pip install 'ggwarp[{extra}]'" in capsys.readouterr().err
