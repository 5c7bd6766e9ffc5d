# SPDX-License-Identifier: Apache-2.0
"""``kernels``: every stage of a mapping iteration against the machine's limits."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from typing import Any, Literal

from benchmarking import gsplat_peer
from benchmarking.inputs.scene import OBJECTS, covering_size, scene_camera, scene_gaussians, scene_mapper
from benchmarking.machine import Limits, measure_limits
from benchmarking.options import (
    BenchmarkError,
    Common,
    cpu_threads,
    image_size,
    is_cpu,
    milliseconds,
    new_record,
    percent,
    thread_count,
)
from benchmarking.record import Check, Record, Row, Section
from benchmarking.stages import RENDERING, Stages, efforts
from benchmarking.timing import Timing, Work, measure
from ggwarp.config import device_name
from ggwarp.geometry.camera import Camera
from ggwarp.pipeline.mapping.mapper import Mapper

AS_MAPPED = "forward + adjoint, as mapping does"
STAGES, WHOLES = "stages of an iteration", "whole passes"

_KL_INTERVAL = 5  # iterations: the 3-D term's share comes round once in so many
_BUDGET_S = 90.0
_COMPILE = """
import json, os, resource, sys, time
from ggwarp.runtime import loading
import ggwarp.pipeline.slam, ggwarp.datasets.built_in.synthetic
loading.init_quietly()
modules = loading.imported_kernel_modules(sys.argv[1])
def cpu():
    uses = (resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(u.ru_utime + u.ru_stime for u in uses)
before, started = cpu(), time.perf_counter()
loading.load(modules, sys.argv[1])
wall = time.perf_counter() - started
sys.stdout.write("\\n" + json.dumps([len(modules), wall, cpu() - before]))
"""


@dataclass(frozen=True)
class KernelsOptions(Common):
    """Each kernel and a whole mapping iteration: time, and how far it is from the machine's limits."""

    size: str = "320x180"
    """Image size, WIDTHxHEIGHT."""
    gaussians: int = 20_000
    """Gaussians; their size is such that about 44 contribute to a pixel, as 20,000 of 2 px do at 320x180."""
    channels: Literal[4, 20] = 20
    """Colour and depth, or identity too."""
    threads: int | None = None
    """CPU threads; default: all this process may use."""
    rounds: int = 30
    """Interleaved repeats; fewer are done where they would take more than 90 seconds."""
    compile: bool = True
    """Measure the compilation of the whole package with an empty cache, too."""


@dataclass(frozen=True)
class Setting:
    """A scene with everything that is run on it."""

    stages: Stages
    mapper: Mapper


def setting(options: KernelsOptions, camera: Camera, channels: int, device: str) -> Setting:
    """Build the scene that ``options`` ask for, with 4 or 20 channels."""
    size = covering_size(options.gaussians, camera.width, camera.height)
    batch = scene_gaussians(options.gaussians, camera, size=size, identity=channels == 20)
    mapper, frame = scene_mapper(batch, camera, device=device)
    return Setting(Stages(mapper, frame, camera), mapper)


def run(options: KernelsOptions) -> Record:
    """Measure and return the record.

    Raises:
        BenchmarkError: an option cannot be used.
    """
    if options.gaussians < 1:
        raise BenchmarkError(f"--gaussians {options.gaussians}: give 1 or more")
    camera = scene_camera(*image_size(options.size))
    threads = thread_count(options.threads)
    record = new_record("kernels", options)
    record.settings["threads"] = threads
    device = device_name(options.device)
    with cpu_threads(threads):
        limits = measure_limits(device, threads)
        main = setting(options, camera, options.channels, device)
        plain = setting(options, camera, 4, device) if options.channels == 20 else None
        rounds = min(options.rounds, 5) if options.quick else options.rounds
        times = measure(works(main, plain), device=device, rounds=rounds, budget_s=_BUDGET_S)
        limits = limits.best(measure_limits(device, threads))
        _fill(record, options, camera, main, times, limits)
        if is_cpu(record):
            record.notes.append("gsplat was not compared: its rasteriser needs a CUDA device")
        else:
            gsplat_peer.compare(record, main.mapper, camera, rounds=rounds)
    if options.compile and not options.quick:
        record.sections.append(Section("compilation, empty kernel cache", [compile_time(device)]))
    return record


def works(main: Setting, plain: Setting | None) -> dict[str, Any]:
    """Return what a round measures: the stages in their order, then whole passes."""
    found: dict[str, Any] = dict(main.stages.works())
    found["forward + adjoint"] = main.stages.forward_and_adjoint
    if plain is not None:
        found[AS_MAPPED] = main.stages.sampled_forward_and_adjoint
    found["iteration"] = Work(main.mapper.iterate, batch=_KL_INTERVAL)
    if plain is not None:
        found["forward + adjoint, 4 channels"] = plain.stages.forward_and_adjoint
        found["iteration, 4 channels"] = Work(plain.mapper.iterate, batch=_KL_INTERVAL)
    return found


def _fill(
    record: Record,
    options: KernelsOptions,
    camera: Camera,
    main: Setting,
    times: dict[str, Timing],
    limits: Limits,
) -> None:
    load = main.stages.load
    record.sections.append(
        Section(
            "the scene",
            [
                {
                    "image": options.size,
                    "Gaussians": load.gaussians,
                    "channels": main.stages.channels,
                    "visible": load.visible,
                    "splat px": load.footprint,
                    "pairs a splat": load.pairs_per_splat,
                    "contributions a pixel": load.per_pixel,
                }
            ],
        )
    )
    record.sections.append(
        Section(
            "the machine",
            [{"threads": record.settings["threads"], "copy GB/s": limits.copy, "FMA GFLOP/s": limits.fma}],
            "copy: bytes read and written; FMA: the best of float32 matrix products (torch's, NumPy's), "
            "before and after the kernels",
        )
    )
    rows = stage_rows(main, camera, times, limits)
    record.sections.append(
        Section(
            STAGES,
            rows,
            "GB/s and GFLOP/s of the least traffic and arithmetic that the equations need (see stages.py); "
            f"least ms: at the machine's limits. Identities on 1 pixel in {main.stages.stride}, as mapping "
            f"does. Cross-entropy and KL: {OBJECTS} objects; "
            f"KL, where it is asked for, comes every {_KL_INTERVAL}th iteration.",
        )
    )
    whole = {name: t for name, t in times.items() if name not in main.stages.works()}
    record.sections.append(
        Section(
            WHOLES,
            [
                {"pass": name, **milliseconds(t), "ns/contribution": 1e9 * t.median / load.contributions}
                for name, t in whole.items()
            ],
            f"an iteration is the mean of {_KL_INTERVAL} in a row; mapping renders identities on 1 pixel in "
            f"{main.stages.stride}, the other passes on all; 4 channels: colour and depth, where other "
            "rasterisers blend 3",
        )
    )
    record.checks += _checks(options, record, times, limits)


def stage_rows(main: Setting, camera: Camera, times: dict[str, Timing], limits: Limits) -> list[Row]:
    """Return a row a stage."""
    rows: list[Row] = []
    load = main.stages.load
    needs = efforts(load, camera, main.stages.channels, OBJECTS + 1, main.stages.stride)
    for name in main.stages.works():
        t, need = times[name], needs[name]
        least = limits.seconds(need.gflop or 0.0, need.gigabytes)
        rows.append(
            {
                "stage": name,
                **milliseconds(t),
                "ns/contribution": 1e9 * t.median / load.contributions if name in RENDERING else None,
                "GB/s": need.gigabytes / t.median,
                "GFLOP/s": None if need.gflop is None else need.gflop / t.median,
                "least ms": 1e3 * least,
                "of the limit %": percent(least / t.median),
            }
        )
    return rows


def _checks(options: KernelsOptions, record: Record, times: dict[str, Timing], limits: Limits) -> list[Check]:
    both, iteration = times["forward + adjoint"], times["iteration"]
    checks = []
    standard = KernelsOptions()
    same = all(getattr(options, n) == getattr(standard, n) for n in ("size", "gaussians", "channels"))
    if is_cpu(record) and same:
        checks.append(
            Check(
                "forward + adjoint x FMA peak", both.median * limits.fma, "<=", 16.0, "GFLOP",
                f"{1e3 * both.median:.1f} ms x {limits.fma:.0f} GFLOP/s",
            )
        )  # fmt: skip
    if "iteration, 4 channels" in times:
        less, base = times["forward + adjoint, 4 channels"], times["iteration, 4 channels"]
        note = "4 channels (colour, depth) stand for 3"
        checks.append(Check("20 channels against 4", both.over(less), "<=", 1.5, "x", note))
        checks.append(
            Check("cost of identity: gg-slam iteration / gs-icp's", iteration.over(base), "<=", 1.35, "x")
        )
    rendering = times.get(AS_MAPPED, both)
    note = "forward + adjoint as mapping does"
    checks.append(Check("iteration / (forward + adjoint)", iteration.over(rendering), "<=", 1.6, "x", note))
    if not is_cpu(record) and (options.size, options.gaussians) == ("1200x680", 300_000):
        checks.append(Check("mapping iteration", 1e3 * iteration.median, "<=", 1.3, "ms", "target: H200"))
    return checks


def compile_time(device: str) -> Row:
    """Compile all kernels that a run loads, in a process with an empty cache."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"WARP_CACHE_PATH": folder}
        command = [sys.executable, "-c", _COMPILE, device]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise BenchmarkError(f"compilation failed: {done.stderr.strip().splitlines()[-1]}")
    modules, wall, cpu = json.loads(done.stdout.strip().splitlines()[-1])
    return {"modules": modules, "wall s": wall, "CPU s": cpu}
