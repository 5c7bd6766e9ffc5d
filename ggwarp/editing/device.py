# SPDX-License-Identifier: Apache-2.0
"""The device that the command renders on."""

from __future__ import annotations

import importlib
import sys

import warp as wp

from ggwarp.results.saved_run import RunError
from ggwarp.runtime import loading

_RENDERING = ("ggwarp.editing.map_view", "ggwarp.editing.inpaint.fitting")


def ready_device(wanted: str | None) -> str:
    """Return the device that ``wanted`` (None: auto) means here, with the kernels loaded on it.

    Raises:
        RunError: there is no such device.
    """
    loading.init_quietly()
    cuda = [d.alias for d in wp.get_cuda_devices()]
    name = (cuda or ["cpu"])[0] if wanted in (None, "auto") else wanted
    if name not in ["cpu", *cuda]:
        raise RunError(f"--device {wanted}: no such device; this machine has {', '.join(['cpu', *cuda])}")
    for module in _RENDERING:
        importlib.import_module(module)
    modules = loading.imported_kernel_modules(name)
    if loading.uncompiled(modules, name):
        print("compiling kernels (first run only)", file=sys.stderr, flush=True)
    loading.load(modules, name)
    return name
