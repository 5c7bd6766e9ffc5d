# SPDX-License-Identifier: Apache-2.0
"""A damaged kernel cache that several programs use at once, or that can only be read."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

LOAD = """
import logging
import ggwarp.kernels.losses.isotropy, ggwarp.kernels.optim.pose_adam, ggwarp.kernels.optim.compact
from ggwarp.runtime import loading
logging.basicConfig(level=logging.WARNING, format="%(message)s")
loading.init_quietly()
modules = loading.imported_kernel_modules("cpu")
loading.load(modules, "cpu")
for module in modules:
    loaded = next(iter(module.execs.values()))
    assert all(loaded.get_kernel_hooks(kernel).forward for kernel in module.kernels.values())
"""


@pytest.fixture
def cache(campaign: bool, tmp_path: Path) -> Path:
    if not campaign:
        pytest.skip("with --reliability")
    folder = tmp_path / "cache"
    assert _loaded(folder) == ("", 0)
    return folder


def _command(folder: Path, *before: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*before, sys.executable, "-c", LOAD],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "WARP_CACHE_PATH": str(folder)},
    )


def _loaded(folder: Path, *before: str) -> tuple[str, int]:
    with _command(folder, *before) as command:
        said, _ = command.communicate()
    return said, command.returncode


def _damage(folder: Path) -> int:
    found = list(folder.rglob("*.o"))
    for path in found:
        path.write_bytes(path.read_bytes()[:1000])
    return len(found)


def test_several_programs_mend_it_at_once(cache: Path) -> None:
    for _ in range(5):
        assert _damage(cache) >= 3
        commands = [_command(cache) for _ in range(4)]
        for command in commands:
            said, _ = command.communicate()
            assert command.returncode == 0 and "Traceback" not in said, said
        assert _loaded(cache) == ("", 0), "all is mended"
        assert not [p.name for p in next(cache.iterdir()).iterdir() if "damaged" in p.name]


def test_it_can_only_be_read(cache: Path) -> None:
    unshare = ("unshare", "--map-root-user", "--mount", "sh", "-c")
    read_only = (*unshare, f'mount --bind {cache} {cache} && mount -o remount,bind,ro {cache} && "$@"', "sh")
    if _loaded(cache, *read_only)[1]:
        pytest.skip("may not mount")
    assert _loaded(cache, *read_only) == ("", 0), "where nothing is to be compiled it serves"
    _damage(cache)
    said, code = _loaded(cache, *read_only)
    lines = said.splitlines()
    assert code == 0 and len(lines) == 2, said
    assert (
        "was damaged" in lines[0]
        and "(Read-only file system): kernels are compiled for this run only" in lines[1]
    )
