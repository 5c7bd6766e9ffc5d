# SPDX-License-Identifier: Apache-2.0
"""3DGS PLY files: written, read back, cross-checked by an independent parser, and refused."""

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ggwarp.io.ply import PlyError, read_ply, write_ply
from ggwarp.map.gaussians import Gaussians

STANDARD = (
    "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
)


def random_gaussians(rng: np.random.Generator, n: int) -> dict[str, np.ndarray]:
    quats = rng.normal(size=(n, 4)).astype(np.float32)
    return {
        "means": rng.normal(size=(n, 3)).astype(np.float32),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "log_scales": rng.normal(size=(n, 3)).astype(np.float32),
        "opacity_logits": rng.normal(size=n).astype(np.float32),
        "colours": rng.normal(size=(n, 3)).astype(np.float32),
        "object_ids": rng.integers(0, 70000, n).astype(np.int32),
        "identities": rng.normal(size=(n, 16)).astype(np.float32),
    }


def parse_by_hand(path: Path) -> list[dict[str, float]]:
    """Read a PLY of floats and ints with struct alone."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    (count,) = [int(line.split()[2]) for line in lines if line.startswith("element")]
    properties = [line.split()[1:] for line in lines if line.startswith("property")]
    record = struct.Struct("<" + "".join({"float": "f", "int": "i"}[kind] for kind, _ in properties))
    assert len(body) == count * record.size
    names = [name for _, name in properties]
    return [dict(zip(names, row, strict=True)) for row in record.iter_unpack(body)]


def standard_file(path: Path, n: int, *, rest: int = 45, order: str = "<") -> dict[str, np.ndarray]:
    """Write what a 3DGS trainer of degree 3 leaves; return its records."""
    names = [*STANDARD[:9], *(f"f_rest_{i}" for i in range(rest)), *STANDARD[9:]]
    table = np.random.default_rng(3).normal(size=(n, len(names))).astype(order + "f4")
    kind = {"<": "little", ">": "big"}[order]
    lines = ["ply", f"format binary_{kind}_endian 1.0", f"element vertex {n}"]
    lines += [f"property float {name}" for name in names] + ["end_header\n"]
    path.write_bytes("\n".join(lines).encode() + table.tobytes())
    return {name: table[:, i] for i, name in enumerate(names)}


def test_what_is_written_is_read_back(tmp_path: Path, rng: np.random.Generator) -> None:
    gaussians = random_gaussians(rng, 50)
    write_ply(tmp_path / "map.ply", Gaussians(**gaussians))
    read = read_ply(tmp_path / "map.ply")
    assert len(read) == 50
    for name, values in gaussians.items():
        got = getattr(read, name)
        assert got.shape == values.shape and got.dtype == values.dtype
        np.testing.assert_allclose(got, values, atol=1e-7)


def test_the_layout_is_that_of_3dgs(tmp_path: Path, rng: np.random.Generator) -> None:
    gaussians = random_gaussians(rng, 7)
    write_ply(tmp_path / "map.ply", Gaussians(**gaussians))
    rows = parse_by_hand(tmp_path / "map.ply")
    assert list(rows[0]) == [*STANDARD, "object_id", *(f"id_{i}" for i in range(16))]
    for i, row in enumerate(rows):
        got = [row[name] for name in STANDARD]
        want = np.concatenate(
            [
                gaussians["means"][i],
                np.zeros(3),
                gaussians["colours"][i],
                [gaussians["opacity_logits"][i]],
                gaussians["log_scales"][i],
                gaussians["quats"][i],
            ]
        )
        np.testing.assert_allclose(got, want, atol=1e-7)
        assert row["object_id"] == gaussians["object_ids"][i]
        np.testing.assert_array_equal([row[f"id_{k}"] for k in range(16)], gaussians["identities"][i])


def test_without_objects_there_are_no_object_fields(tmp_path: Path, rng: np.random.Generator) -> None:
    gaussians = random_gaussians(rng, 3)
    del gaussians["object_ids"], gaussians["identities"]
    write_ply(tmp_path / "map.ply", Gaussians(**gaussians))
    assert list(parse_by_hand(tmp_path / "map.ply")[0]) == STANDARD
    read = read_ply(tmp_path / "map.ply")
    assert read.object_ids is None and read.identities is None


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(n=st.integers(0, 40))
def test_any_number_of_gaussians(tmp_path: Path, n: int) -> None:
    gaussians = random_gaussians(np.random.default_rng(n), n)
    write_ply(tmp_path / "map.ply", Gaussians(**gaussians))
    np.testing.assert_array_equal(read_ply(tmp_path / "map.ply").means, gaussians["means"])


def test_rotations_are_normalised_and_zero_becomes_identity(tmp_path: Path, rng: np.random.Generator) -> None:
    gaussians = random_gaussians(rng, 2)
    gaussians["quats"] = np.array([[0, 3, 0, 4], [0, 0, 0, 0]], np.float32)
    write_ply(tmp_path / "map.ply", Gaussians(**gaussians))
    np.testing.assert_allclose(
        read_ply(tmp_path / "map.ply").quats, [[0, 0.6, 0, 0.8], [1, 0, 0, 0]], atol=1e-7
    )


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("rest", [0, 45])
def test_files_of_other_trainers(tmp_path: Path, order: str, rest: int) -> None:
    want = standard_file(tmp_path / "point_cloud.ply", 11, rest=rest, order=order)
    read = read_ply(tmp_path / "point_cloud.ply")
    np.testing.assert_array_equal(read.means[:, 2], want["z"])
    np.testing.assert_array_equal(read.colours[:, 1], want["f_dc_1"])
    np.testing.assert_array_equal(read.opacity_logits, want["opacity"])
    np.testing.assert_array_equal(read.quats[:, 0], want["rot_0"])
    assert read.object_ids is None


def test_elements_after_the_vertices_are_skipped(tmp_path: Path, rng: np.random.Generator) -> None:
    gaussians = random_gaussians(rng, 4)
    write_ply(tmp_path / "map.ply", Gaussians(**gaussians))
    data = (tmp_path / "map.ply").read_bytes()
    faces = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "map.ply").write_bytes(data.replace(b"end_header\n", faces) + struct.pack("<B3i", 3, 0, 1, 2))
    np.testing.assert_array_equal(read_ply(tmp_path / "map.ply").means, gaussians["means"])


HEADER = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "not a PLY"),
        (b"solid teapot", "not a PLY"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nend_header\n", "only binary"),
        (HEADER + b"property float x\n", "malformed or cut short"),
        (HEADER + b"\xff\xfe\xfa\n", "malformed"),
        (b"ply\nelement vertex 1\nend_header\n", "malformed"),
        (HEADER + b"property float x\nproperty float y\nend_header\n" + bytes(8), "has no z"),
        (HEADER + b"property quad x\nend_header\n", "unknown type quad"),
        (HEADER + b"property float x\nproperty float x\nend_header\n", "occurs twice"),
        (HEADER + b"property list uchar int x\nend_header\n", "hold lists"),
        (b"ply\nformat binary_little_endian 1.0\nelement face 1\n", "before the vertices"),
    ],
)
def test_what_is_no_gaussian_map_is_refused_with_a_reason(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "bad.ply").write_bytes(content)
    with pytest.raises(PlyError, match=says) as error:
        read_ply(tmp_path / "bad.ply")
    assert "bad.ply" in str(error.value) and "\n" not in str(error.value)


def test_a_truncated_file_is_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    write_ply(tmp_path / "map.ply", Gaussians(**random_gaussians(rng, 5)))
    (tmp_path / "map.ply").write_bytes((tmp_path / "map.ply").read_bytes()[:-1])
    with pytest.raises(PlyError, match=r"truncated: 5 Gaussians take 680 bytes, 679 are left"):
        read_ply(tmp_path / "map.ply")


def test_arrays_that_do_not_fit_are_refused_and_leave_no_file(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    gaussians = random_gaussians(rng, 5)
    gaussians["means"] = gaussians["means"][:4]
    with pytest.raises(ValueError, match="means has shape"):
        write_ply(tmp_path / "map.ply", Gaussians(**gaussians))
    assert not list(tmp_path.iterdir())
