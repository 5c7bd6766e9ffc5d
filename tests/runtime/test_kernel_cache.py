# SPDX-License-Identifier: Apache-2.0
"""A cache of compiled kernels that was damaged, or that takes nothing more."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from ggwarp.runtime import kernel_cache

_LOADED = """
import logging, sys
import numpy as np, warp as wp
from ggwarp.kernels.losses import isotropy
from ggwarp.runtime import kernel_cache, loading
logging.basicConfig(level=logging.WARNING, format="%(message)s")
loading.init_quietly()
modules = loading.imported_kernel_modules("cpu")
folder = lambda: kernel_cache.folder_of(modules[0], 1)

def load():
    modules[0].unload()
    loading.load(modules, "cpu")
    assert loading.uncompiled(modules, "cpu") == [] and len(kernel_cache.binaries(folder())) == 1
    wp.init()
    pull = wp.zeros(1, dtype=wp.vec3, device="cpu")
    isotropy.pull_round(
        wp.array([[0.0, 0.0, np.log(4.0)]], dtype=wp.vec3, device="cpu"), weight=3.0, d_log_scales=pull,
        ranks=wp.zeros(1, dtype=wp.int32, device="cpu"), device="cpu",
    )
    np.testing.assert_allclose(pull.numpy(), [[-2 / 3, -2 / 3, 16 / 3]], rtol=1e-6)

load()
"""

_DAMAGED = """
[binary] = kernel_cache.binaries(folder())
whole = binary.read_bytes()
flipped = bytearray(whole)
flipped[len(whole) // 3] ^= 4
half = len(whole) // 2
for sealed in (True, False):
    for kind, data in {
        "empty": b"", "cut": whole[:half], "one byte short": whole[:-1], "zeros": bytes(len(whole)),
        "zeros at the end": whole[:half] + bytes(len(whole) - half), "another": whole[:64] * 50,
        **({"a bit": bytes(flipped)} if sealed else {}),
    }.items():
        binary.write_bytes(data)
        if not sealed:
            binary.with_name(binary.name + ".sha256").unlink()
        print(kind, file=sys.stderr)
        load()
        assert kernel_cache.is_sealed(folder())
        whole = binary.read_bytes()
(folder() / (folder().name + ".meta")).write_text("{")
load()
"""


def _run(code: str, cache: Path, **environment: str) -> list[str]:
    """Run ``code`` with a kernel cache and return what it said."""
    done = subprocess.run(
        [sys.executable, "-c", _LOADED + code],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "WARP_CACHE_PATH": str(cache), **environment},
    )
    assert done.returncode == 0, done.stdout
    return done.stdout.splitlines()


def test_what_is_damaged_is_compiled_again(tmp_path: Path) -> None:
    said = _run(_DAMAGED, tmp_path)
    mended = [line for line in said if line.endswith("was damaged: losses.isotropy compiled again")]
    assert len(mended) == 7 + 6 + 1 and len(said) == 2 * len(mended) - 1, said
    assert not [p for p in (tmp_path / wp.__version__).iterdir() if "damaged" in p.name]


def test_what_looks_whole_and_lacks_a_kernel_is_compiled_again(tmp_path: Path) -> None:
    """Without a seal only Warp can tell: here the kernel's name is another."""
    code = """
[binary] = kernel_cache.binaries(folder())
binary.write_bytes(binary.read_bytes().replace(b"isotropy_kernel", b"isotropy_kennel"))
binary.with_name(binary.name + ".sha256").unlink()
load()
"""
    said = _run(code, tmp_path)
    assert len(said) == 1 and said[0].endswith("was damaged: losses.isotropy compiled again")


@pytest.mark.parametrize("place", ["below a file", "full"])
def test_a_cache_that_takes_nothing_is_replaced_for_the_run(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").touch()
    cache = tmp_path / "file" if place == "below a file" else tmp_path / "cache"
    full = """
import errno, os, pathlib
write_bytes = pathlib.Path.write_bytes
def write(path, data):
    if str(path).startswith(os.environ["WARP_CACHE_PATH"]):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    return write_bytes(path, data)
pathlib.Path.write_bytes = write
original = wp._src.build.build_cpu
def build(path, *arguments, **options):
    write(pathlib.Path(path), b"")
    return original(path, *arguments, **options)
wp._src.build.build_cpu = build
"""
    code = _LOADED if place == "below a file" else _LOADED.replace("\nload()\n", full + "load()\n")
    said = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, "WARP_CACHE_PATH": str(cache), "TMPDIR": str(tmp_path)},
    )
    assert said.returncode == 0, said.stderr
    [line] = said.stderr.splitlines()
    assert line.startswith(f"the kernel cache {cache}") and "compiled for this run only" in line
    assert {p.name for p in tmp_path.iterdir()} <= {"file", "cache"}, "the temporary one is gone"
    assert not [p for p in tmp_path.rglob("*") if p.name.startswith(("wp_", "probe"))]


def test_no_place_at_all(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**options):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(wp.config, "kernel_cache_dir", "/cache")
    monkeypatch.setattr(kernel_cache.tempfile, "mkdtemp", refuse)
    with pytest.raises(OSError, match=r"No space left on device; kernels need some 5 MB.*WARP_CACHE_PATH"):
        kernel_cache.use_temporary("/cache", OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/cache"))
    kernel_cache.use_temporary("/left already", OSError(errno.ENOSPC, "full", "/left already"))
    assert wp.config.kernel_cache_dir == "/cache"


def test_words_of_native_code_are_held(capfd) -> None:
    with kernel_cache.held_stderr() as lines:
        os.write(2, b"one\ntwo\n")
    os.write(2, b"three\n")
    assert lines == ["one", "two"] and capfd.readouterr().err == "three\n"


def test_a_folder_that_another_program_removes_is_no_failure(tmp_path: Path) -> None:
    kernel_cache.remove(tmp_path / "gone")
    assert kernel_cache.binaries(tmp_path / "gone") == [] and not kernel_cache.is_damaged(tmp_path / "gone")
    kernel_cache.seal(tmp_path / "gone")
    assert list(tmp_path.iterdir()) == []
