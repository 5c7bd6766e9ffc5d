# SPDX-License-Identifier: Apache-2.0
"""Compile every kernel beforehand.

    ggwarp precompile                               for the devices of this machine
    ggwarp precompile --arch 80 90 --out DIR        for others, which need not be here

Neither a GPU nor a driver is needed. The binaries lie in a kernel cache as Warp looks for them: in its own,
or in DIR, which ``WARP_CACHE_PATH=DIR`` makes the cache of a later run. That may be on another machine, with
the same versions of Warp and of this package.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence

import warp as wp

from ggwarp.runtime import kernel_cache, loading


def main(arguments: Sequence[str] | None = None) -> int:
    """Compile as ``arguments`` say; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="ggwarp precompile",
        description="Compile every kernel beforehand; neither a GPU nor a driver is needed.",
    )
    parser.add_argument(
        "--arch",
        type=int,
        nargs="+",
        metavar="CC",
        help="CUDA architectures to compile for, such as 80 90; default: the devices of this machine",
    )
    parser.add_argument("--out", metavar="DIR", help="kernel cache to write to (default: Warp's own)")
    options = parser.parse_args(arguments)
    if options.out is not None:
        os.environ["WARP_CACHE_PATH"] = options.out
    try:
        loading.init_quietly()
        if kernel_cache.is_temporary():
            return 2  # said already
        if full := kernel_cache.why_not_writable():
            raise full
        for target in options.arch or wp.get_devices():
            _compile(target)
    except (loading.ArchitectureError, OSError) as error:
        reason = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) else error
        print(f"ggwarp precompile: {reason}", file=sys.stderr)
        return 2
    print(f"in {wp.config.kernel_cache_dir}")
    if options.out is not None:
        print(f"to use them: WARP_CACHE_PATH={options.out} ggwarp run ...")
    return 0


def _compile(target: int | wp.Device) -> None:
    started = time.perf_counter()
    if isinstance(target, int):
        name, (done, there) = f"sm_{target}", loading.compile_for(target)
    else:
        modules = loading.kernel_modules(target)
        done = len(loading.uncompiled(modules, target))
        name, there = target.alias, len(modules) - done
        loading.load(modules, target)
    print(f"{name}: {done} modules compiled, {there} were there, {time.perf_counter() - started:.0f} s")


if __name__ == "__main__":
    sys.exit(main())
