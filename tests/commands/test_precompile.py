# SPDX-License-Identifier: Apache-2.0
"""What is compiled without a GPU is what a GPU's run looks for."""

import os
import subprocess
import sys

import pytest

_ONE_MODULE = """
import sys
from ggwarp.runtime import loading
loading._names = lambda kind=None: ["ggwarp.kernels.identity.random"]
"""

_COMPILE = """
from ggwarp.commands import precompile
sys.exit(precompile.main(sys.argv[1:]))
"""

_LOOK = """
import warp as wp
from warp._src import context
loading.init_quietly()
[module] = loading.all_kernel_modules()
def gpu(arch, driver):
    # A device as Warp makes one where there is a GPU, as far as it decides what is loaded.
    device = object.__new__(context.Device)
    device.ordinal, device.alias, device.arch, device._context = 0, "cuda:0", arch, 1
    device.is_cubin_supported = arch in context.runtime.nvrtc_supported_archs
    device.runtime = context.runtime
    context.runtime.driver_version = driver
    return device
for arch in (80, 90):
    for driver in ((12, 4), (99, 0)):
        device = gpu(arch, driver)
        wp.get_device = lambda _, device=device: device
        warm = not loading.uncompiled([module], device)
        print(arch, warm, warm and not module._compile(device))
"""


def _run(code: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", _ONE_MODULE + code, *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
    )


def test_a_later_run_on_that_architecture_compiles_nothing(tmp_path):
    done = _run(_COMPILE, "--arch", "90", "--out", str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "sm_90: 1 modules compiled, 0 were there" in done.stdout
    assert f"WARP_CACHE_PATH={tmp_path} " in done.stdout
    found = _run(_LOOK, WARP_CACHE_PATH=str(tmp_path))
    assert found.stdout.splitlines() == ["80 False False"] * 2 + ["90 True True"] * 2, found.stderr
    again = _run(_COMPILE, "--arch", "90", "--out", str(tmp_path))
    assert "sm_90: 0 modules compiled, 1 were there" in again.stdout


def test_this_machine_s_devices_are_the_default(tmp_path):
    done = _run(_COMPILE, "--out", str(tmp_path))
    assert done.returncode == 0 and "cpu: 1 modules compiled, 0 were there" in done.stdout
    assert "cpu: 0 modules compiled, 1 were there" in _run(_COMPILE, "--out", str(tmp_path)).stdout


@pytest.mark.parametrize("arch", ["42", "9.0"])
def test_an_unknown_architecture_is_named(tmp_path, arch):
    done = _run(_COMPILE, "--arch", arch, "--out", str(tmp_path))
    assert done.returncode == 2 and arch in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


def test_a_folder_that_cannot_be_written_to_is_refused(tmp_path):
    (tmp_path / "file").touch()
    done = _run(_COMPILE, "--out", str(tmp_path / "file"))
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert str(tmp_path / "file") in done.stderr and "Not a directory" in done.stderr
