# SPDX-License-Identifier: Apache-2.0
"""The package offers functions, imported when asked for; no module hides one."""

import importlib
import pkgutil
import subprocess
import sys

import pytest

import ggwarp.ops


def test_the_functions_are_there():
    assert ggwarp.ops.__all__ == ["gicp", "knn", "render", "ssim"]
    for name in ggwarp.ops.__all__:
        function = getattr(ggwarp.ops, name)
        assert callable(function) and function.__name__ == name and "Args:" in function.__doc__
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = ggwarp.ops.nonsense


def test_no_module_takes_a_functions_place():
    modules = {module.name for module in pkgutil.iter_modules(ggwarp.ops.__path__)}
    assert not modules & set(ggwarp.ops.__all__)
    for name in modules:
        importlib.import_module(f"ggwarp.ops.{name}")
    assert callable(ggwarp.ops.knn)


def test_a_function_brings_only_what_it_needs():
    code = "import sys; from ggwarp.ops import knn; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "ggwarp.ops.neighbours" in loaded
    assert not [m for m in loaded if m.startswith("ggwarp.kernels.raster") or m == "ggwarp.ops.rendering"]
