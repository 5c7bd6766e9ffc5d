# SPDX-License-Identifier: Apache-2.0
"""``resources``: what the CUDA kernels ask of a GPU, read from their binaries; no GPU is needed."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sysconfig
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import warp as wp

from benchmarking.cubins.lanes import wavefronts
from benchmarking.cubins.sass import Block, Loop, blocks_of, loops_of, parse, way_through
from benchmarking.options import BenchmarkError, Common, new_record
from benchmarking.record import Check, Record, Row, Section
from ggwarp.runtime import loading

KERNELS, SPLATS = "kernels", "instructions a splat costs a warp"

_KERNELS_NOTE = (
    "registers and stack a thread (stack: arrays indexed at run time, and spills), shared memory and threads "
    "a block, as compiled; blocks: on a multiprocessor at once, as these four allow"
)
_SPLATS_NOTE = (
    "of the loop that compares ln alpha with ln 1/255, for one splat that a warp looks at: the shortest "
    "way that fails, and the longest that passes. Wavefronts: of shared memory, for 16 splats that all 8 "
    "warps of a tile blend: the bytes of the places that a warp's lanes ask for, over 128, from what their "
    "addresses depend on; conflicts of banks are not looked at, and loops inside the one over groups of 16 "
    "count once"
)

_MARK = re.compile(r"-5\.5412635")  # ln 1/255: what ln alpha is compared with
_TOOLS = ("cuobjdump", "nvdisasm")
_REMEDY = "pip install nvidia-cuda-cuobjdump nvidia-cuda-nvdisasm, or put a CUDA toolkit's bin on PATH"
_USAGE = re.compile(r"Function (\w+):\s*\n\s*REG:(\d+) STACK:(\d+) SHARED:(\d+)")
_NAME = re.compile(r"_?(\w+?)_[0-9a-f]{8}_cuda_kernel_forward")
_SM_SHARED = {80: 164, 90: 228}
"""Shared memory of a multiprocessor by architecture, KiB; another's is taken to be 100."""

_SM_REGISTERS, _SM_THREADS, _SM_BLOCKS, _RESERVED = 65536, 2048, 32, 1024
_WARPS = 8
_GROUP = 16


@dataclass(frozen=True)
class ResourcesOptions(Common):
    """Registers, memory and spills of each CUDA kernel, and what a splat costs, from compiled binaries."""

    arch: int = 90
    """Compute capability without its dot, such as 80 (A100) or 90 (H100)."""


def run(options: ResourcesOptions) -> Record:
    """Compile the kernels, read the binaries and return the record.

    Raises:
        BenchmarkError: NVIDIA's tools are absent, or do not know the architecture.
    """
    tools = _tools()
    record = new_record("resources", options)
    record.notes.clear()  # how busy the machine is does not matter
    record.machine["device"] = f"sm_{options.arch}"
    kernels: list[Row] = []
    splats: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for module, threads, cubin in _compiled(options.arch, Path(folder)):
            shared = json.loads(cubin.with_name(cubin.name.split(".sm")[0] + ".meta").read_text())
            kernels += _usage(module, _call(tools, "-res-usage", cubin), shared, options.arch, threads)
            if "composite" in module:
                splats += _splat_rows(_call(tools, "-sass", cubin))
    record.sections.append(Section(KERNELS, kernels, _KERNELS_NOTE))
    record.sections.append(Section(SPLATS, sorted(splats, key=lambda row: row["kernel"]), _SPLATS_NOTE))
    record.checks += _checks(kernels, splats)
    return record


def _tools() -> str:
    """Return cuobjdump's path; what it calls in turn lies beside it or on PATH.

    Raises:
        BenchmarkError: there is none.
    """
    beside = os.pathsep.join(map(str, Path(sysconfig.get_paths()["purelib"]).glob("nvidia/*/bin")))
    path = os.pathsep.join(part for part in (beside, os.environ.get("PATH", "")) if part)
    for name in _TOOLS:
        if shutil.which(name, path=path) is None:
            raise BenchmarkError(f"resources: no {name} here; {_REMEDY}")
    found = shutil.which(_TOOLS[0], path=path)
    assert found is not None
    return found


def _call(cuobjdump: str, what: str, cubin: Path) -> str:
    path = os.pathsep.join([str(Path(cuobjdump).parent), os.environ.get("PATH", "")])
    command = [cuobjdump, what, str(cubin)]
    done = subprocess.run(
        command, env=os.environ | {"PATH": path}, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise BenchmarkError(f"resources: cuobjdump {what}: {(done.stderr or done.stdout).strip()}")
    return done.stdout


def _compiled(arch: int, folder: Path) -> Iterator[tuple[str, int, Path]]:
    """Yield the name, the threads of a block and the binary of every module that a GPU runs.

    Raises:
        BenchmarkError: the compiler does not know the architecture.
    """
    modules = [
        m
        for m in loading.all_kernel_modules()
        if loading.ONE_DEVICE.get(m.name.removeprefix("ggwarp.kernels.")) != "cpu"
    ]

    def build(module: Any) -> tuple[str, int, Path]:
        name = module.name.removeprefix("ggwarp.kernels.")
        try:
            files = wp.compile_aot_module(module, arch=arch, module_dir=folder / name, use_ptx=False)
        except Exception as error:
            raise BenchmarkError(f"--arch {arch}: {error}; give a compute capability such as 90") from error
        cubin = next(Path(f) for f in files if str(f).endswith(".cubin"))
        return name, module.options["block_dim"], cubin

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield from pool.map(build, modules)


def _usage(module: str, text: str, shared: dict[str, int], arch: int, threads: int) -> list[Row]:
    """Return a row a kernel of a module."""
    rows = []
    for function, registers, stack, static in _USAGE.findall(text):
        memory = int(static) + shared.get(f"{function}_smem_bytes", 0)
        rows.append(
            {
                "module": module,
                "kernel": _plain(function),
                "registers": int(registers),
                "stack B": int(stack),
                "shared B": memory,
                "threads": threads,
                "blocks": _blocks(int(registers), memory, arch, threads),
            }
        )
    return sorted(rows, key=lambda row: row["kernel"])


def _blocks(registers: int, shared: int, arch: int, threads: int) -> int:
    """Return how many blocks a multiprocessor holds at once."""
    by_registers = _SM_REGISTERS // (-(-registers // 8) * 8 * threads)
    by_memory = 1024 * _SM_SHARED.get(arch, 100) // (shared + _RESERVED)
    return min(by_registers, by_memory, _SM_THREADS // threads, _SM_BLOCKS)


def _plain(function: str) -> str:
    found = _NAME.fullmatch(function)
    return found[1] if found else function


def _splat_rows(text: str) -> list[Row]:
    """Return a row a composite: what a splat costs that is looked at, skipped or blended."""
    rows = []
    for function, code in parse(text).items():
        blocks = blocks_of(code)
        marks = {
            k: n for k, b in enumerate(blocks) if (n := sum(bool(_MARK.search(i.operands)) for i in b.code))
        }
        loops = loops_of(blocks)
        tested = [loop for loop in loops if marks.keys() & loop.body]
        if not tested:
            continue
        loop = tested[0]
        blends = {k for k in loop.body if any(i.name.startswith("MUFU.EX2") for i in blocks[k].code)}
        rare = {k for k in loop.body if any(i.operation == "CALL" for i in blocks[k].code)}
        skipped = way_through(blocks, loop, marks, without=blends, longest=False)
        blended = way_through(blocks, loop, marks, without=rare, longest=True)
        rows.append(
            {
                "kernel": _plain(function),
                "skipped": None if skipped is None else skipped.each,
                "blended": None if blended is None else blended.each,
                "16-byte loads": sum("128" in i.name and "LD" in i.operation for b in blocks for i in b.code),
                "wavefronts": _wavefronts(blocks, loops, loop, marks),
            }
        )
    return rows


def _wavefronts(blocks: list[Block], loops: list[Loop], walk: Loop, marks: dict[int, int]) -> float:
    """Return the shared memory's wavefronts of 16 blended splats; see the section's note."""
    found = wavefronts(blocks)

    def cost(k: int) -> int:
        return sum(found.get(i.address, 0) for i in blocks[k].code)

    blended = way_through(blocks, walk, marks, without=set(), longest=True, cost=cost)
    assert blended is not None
    total = _GROUP * blended.each
    # The sums over pixels of a group of 16 stand around its walk.
    around = next((loop for loop in loops if walk.body < loop.body), None)
    if around is not None:
        once = way_through(
            blocks,
            around,
            {walk.head: 1},
            without=set(),
            longest=True,
            cost=lambda k: 0 if k in walk.body else cost(k),
        )
        total += once.length if once is not None else 0
    return _WARPS * total


def _checks(kernels: list[Row], splats: list[Row]) -> list[Check]:
    of = {row["kernel"]: row for row in splats}
    registers = {row["kernel"]: row["registers"] for row in kernels}
    forward, adjoint = of.get("composite_cuda_20", {}), of.get("composite_cuda_adjoint_20", {})
    name = "composite, 20 channels"
    return [
        Check(f"{name}: a skipped splat", forward.get("skipped"), "<=", 36.0, "instructions"),
        Check(f"{name}: a blended splat", forward.get("blended"), "<=", 88.0, "instructions"),
        Check(f"{name}: registers", registers.get("composite_cuda_20"), "<=", 64.0),
        Check("its adjoint: 16 splats", adjoint.get("wavefronts"), "<=", 1300.0, "wavefronts"),
    ]
