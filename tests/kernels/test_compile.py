# SPDX-License-Identifier: Apache-2.0
"""Every kernel module that a GPU runs compiles for those in use; neither a GPU nor a driver is needed."""

import json

import pytest
import warp as wp

from ggwarp.runtime import loading

MOST_SHARED = 99 * 1024 - 2304
"""Shared memory of a GeForce's block (compute capability 8.6 to 12.0), less what Warp takes itself."""

MODULES = loading.all_kernel_modules()


def _name(module):
    return module.name.rsplit(".", 1)[-1]


ON_CUDA = [m for m in MODULES if loading.ONE_DEVICE.get(_name(m)) != "cpu"]


def test_modules_are_found():
    names = {_name(m) for m in MODULES}
    assert {"gicp", "project", "tiles", "ssim", "adam"} <= names
    assert sum(name.startswith("composite") for name in names) >= 2, "forward and adjoint"
    assert "math" not in names, "a module of functions alone needs no binary of its own"


@pytest.mark.parametrize("arch", [80, 90])
@pytest.mark.parametrize("module", ON_CUDA, ids=_name)
def test_compiles_for_cuda(module, arch, tmp_path):
    artefacts = wp.compile_aot_module(module, arch=arch, module_dir=tmp_path)
    assert artefacts and all(path.stat().st_size > 0 for path in artefacts)
    (meta,) = tmp_path.glob("*.meta")
    shared = json.loads(meta.read_text())
    assert all(size <= MOST_SHARED for name, size in shared.items() if name.endswith("_smem_bytes"))
