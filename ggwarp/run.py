# SPDX-License-Identifier: Apache-2.0
"""The command: ``python -m ggwarp.run --seq office0``."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

import ggwarp
from ggwarp.config import (
    ConfigError,
    RunConfig,
    check,
    device_name,
    frame_indices,
    image_scale,
    load_config,
    preset_config,
)
from ggwarp.console import Display, open_display
from ggwarp.datasets import BUILT_IN, Dataset, DatasetError, FrameReader, WithoutDepth, open_dataset
from ggwarp.io.camera import write_camera
from ggwarp.io.toml import write_toml
from ggwarp.monocular import monocular
from ggwarp.pipeline.scheduler import LiveScheduler, Scheduler, UncappedScheduler
from ggwarp.pipeline.slam import Slam
from ggwarp.results import run_folder
from ggwarp.results.record import RunRecord
from ggwarp.runtime import loading
from ggwarp.session import Interruption, evaluate, load_kernels, refine, save, track_and_map

FAILED = 1
USER_ERROR = 2
INTERRUPTED = 130

RESULTS = {
    "trajectory": [
        "frames",
        "frames_lost",
        "frames_skipped",
        "alignment",
        "ate_rmse_cm",
        "ate_mean_cm",
        "rpe_rmse_cm",
    ],
    "picture, all frames": ["psnr", "psnr_exposed", "ssim", "lpips", "depth_l1_cm"],
    "picture, held-out frames": [
        "heldout_psnr",
        "heldout_psnr_exposed",
        "heldout_ssim",
        "heldout_lpips",
        "heldout_depth_l1_cm",
    ],
    "objects": [
        "miou",
        "heldout_miou",
        "miou_matched",
        "miou_interior",
        "pq",
        "objects_true",
        "objects_found",
        "miou_against",
    ],
    "map": [
        "gaussians",
        "tracking_keyframes",
        "mapping_keyframes",
        "mapping_iterations",
        "refine_iterations",
    ],
    "pace": [
        "fps",
        "tracking_ms",
        "latency_ms_p50",
        "latency_ms_p95",
        "frames_late",
        "late_ms_max",
        "frames_behind_max",
        "mapping_ms",
        "iterations_per_frame",
    ],
    "time and memory": ["refine_s", "wall_s", "peak_memory_mb"],
}
"""What the closing table shows, and in which order."""


@dataclass(frozen=True)
class Command:
    """Object-level RGB-D Gaussian-splatting SLAM."""

    run: Annotated[RunConfig, tyro.conf.arg(name="")]
    config: Path | None = None
    """A saved config.toml to start from, instead of a preset."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code.

    0; 1: a failure on the way, what there was is saved; 2: the user's mistake; 130: Ctrl-C.
    """
    started = time.perf_counter()
    display: Display | None = None
    try:
        config = parse(sys.argv[1:] if arguments is None else list(arguments))
        display = open_display()
        with Interruption() as interruption:
            return execute(config, display, interruption, started)
    except (ConfigError, DatasetError) as error:
        return _refuse(display, str(error))
    except MemoryError:
        return _refuse(display, "out of memory: try a smaller --scale, or fewer --frames")
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _refuse(display, f"{where}{error.strerror or error}")
    except KeyboardInterrupt:
        return _refuse(display, "interrupted; nothing was saved", INTERRUPTED)


def parse(arguments: list[str]) -> RunConfig:
    """Return the configuration that the command line asks for.

    Options override the file given by ``--config``, or else the preset.

    Raises:
        ConfigError: an option cannot be used.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    first.add_argument("--config", type=Path)
    first.add_argument("--preset")
    try:
        start, _ = first.parse_known_args(arguments)
    except argparse.ArgumentError:
        start = argparse.Namespace(config=None, preset=None)  # tyro says what is wrong
    if start.config is not None and start.preset is not None:
        raise ConfigError("--config and --preset: give one of them; a saved configuration has its preset")
    base = load_config(start.config) if start.config is not None else preset_config(start.preset or "gg-slam")
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            command = tyro.cli(Command, prog="ggwarp", args=arguments, default=Command(base, start.config))
    except SystemExit as stop:
        if stop.code == 0:  # --help
            raise
        raise ConfigError(f"{_first_sentence(complaint.getvalue())} (--help lists the options)") from None
    check(command.run)
    return command.run


def _first_sentence(boxed: str) -> str:
    """Return what tyro's box of several lines begins with, on one line."""
    words: list[str] = []
    for line in boxed.splitlines()[1:]:
        text = line.strip("│╰╯─ ")
        if not text and words:
            break
        words += text.split()
    return " ".join(words).removesuffix(".") or boxed.strip()


def execute(config: RunConfig, display: Display, interruption: Interruption, started: float) -> int:
    """Run ``config`` from the data to the table of results; return the exit code."""
    display.note(f"ggwarp {ggwarp.__version__}: {config.seq}, preset {config.preset}")
    loading.init_quietly()
    device = device_name(config.device)
    seq = config.seq
    assert seq is not None, "check() has seen to it"
    dataset = open_dataset(
        seq,
        data_root=config.data_root(),
        masks=config.mask_folder,
        faults=config.built_in,
        intrinsics=config.intrinsics,
    )
    if not len(dataset):
        raise DatasetError(f"{config.seq}: the sequence is empty")
    if dataset.kind != "synthetic" and config.built_in != type(config.built_in)():
        raise ConfigError(
            f"--built-in.*: {seq} is a recording; only the built-in office and wall take faults"
        )
    if config.mono or not dataset.has_depth:
        config, dataset = monocular(config), WithoutDepth(dataset)
    indices = frame_indices(config.frames, len(dataset))
    scale = image_scale(config.scale, dataset.camera, device)
    every = max(1, -(-len(indices) // 10)) if config.save_renders is None else config.save_renders
    config = dataclasses.replace(config, device=device, scale=scale, save_renders=every)
    name = seq if dataset.kind == "synthetic" else dataset.name
    folder = run_folder.create_run_folder(config.out, name)
    write_toml(dataclasses.replace(config, out=None), folder / "config.toml")
    _introduce(config, dataset, len(indices), display)

    reader = FrameReader(dataset, indices, scale=scale)
    write_camera(folder / "camera.json", reader.camera)
    # Without masks there is no object to learn: the picture gets the time instead.
    system = dataclasses.replace(config.slam(), use_identity=config.use_identity and dataset.has_masks)
    slam = Slam(
        system, reader.camera, reader.sensor_camera, device=device, scheduler=_scheduler(config, len(indices))
    )
    concurrent = _concurrent(config, slam)
    load_kernels(device, display)
    # The objects of untracked masks are numbered by the map.
    names = getattr(dataset, "class_names", {}) if config.tracked_masks else {}
    record = RunRecord(name, dataset.kind, device, class_names=names, monocular=config.mono)
    with reader:
        kept = track_and_map(slam, reader, record, display, interruption, concurrent=concurrent)
    if not record.reports and record.failure is None:
        if interruption.requested:
            raise KeyboardInterrupt
        first = next(iter(record.skipped.values()))
        raise DatasetError(f"{dataset.name}: no frame could be used; the first: {first}")
    refine(slam, config.refine, record, display, interruption)
    if record.failure is not None:
        _explain(record.failure, display)  # first: what follows may fail for the same reason
    record.correct(slam.fitted_poses())
    evaluate(slam, reader, kept, record, folder, display, interruption, every=every)
    display.stage("saving")
    metrics = save(slam, record, folder, started)
    display.close()
    share = f"{len(record.reports)} of {len(indices)} frames"
    if record.failure is not None:
        display.note(f"failed after {share}; saved in {folder}")
        return FAILED
    if interruption.requested:
        display.note(f"interrupted after {share}; saved in {folder}")
        return INTERRUPTED
    display.results(metrics, RESULTS)
    display.note(f"results in {folder}")
    return 0


def _scheduler(config: RunConfig, frames: int) -> Scheduler | None:
    """Return what paces the run; None: a fixed amount of mapping a frame."""
    if config.fps is None:
        return None
    return UncappedScheduler() if config.fps == "uncapped" else LiveScheduler(config.fps, frames=frames)


def _concurrent(config: RunConfig, slam: Slam) -> bool:
    """Return whether to track beside the mapper.

    Raises:
        ConfigError: it is asked for, but tracking needs what is being mapped.
    """
    if config.pipelined == "on" and slam.sequential_only:
        raise ConfigError(
            "--pipelined on: here tracking looks at the Gaussians being mapped, and works in turn with "
            "mapping; leave the option out"
        )
    if config.pipelined == "auto":
        return config.fps == "uncapped" and not slam.sequential_only
    return config.pipelined == "on"


def _explain(failure: Exception, display: Display) -> None:
    """Say what ended the run; where it looks like a fault of ours, say where in the code, too."""
    reason = failure.__cause__ or failure
    display.close()
    if not isinstance(reason, (DatasetError, OSError, MemoryError)):
        traceback.print_exception(reason)
    what = f"{type(reason).__name__}: {reason}" if str(reason) else type(reason).__name__
    print(f"ggwarp: {failure}: {what}", file=sys.stderr)


def _introduce(config: RunConfig, dataset: Dataset, frames: int, display: Display) -> None:
    if dataset.kind == "synthetic" and config.seq not in BUILT_IN:
        display.note(
            f"{config.seq} is not under {config.data_root()}: using the built-in synthetic office instead "
            f"(the real one: ggwarp download replica {config.seq})"
        )
    size, native = dataset.camera.scaled(config.scale or 1.0), dataset.camera
    display.note(
        f"{frames} frames on {config.device} at {size.width}x{size.height} "
        f"(--scale {config.scale:g} of {native.width}x{native.height})"
    )
    if config.mono:
        display.note("no depth: tracking by colour alone, no scale, objects are not learnt")
    elif config.use_identity and not dataset.has_masks:
        display.note("no object masks (--masks DIR gives some): objects are not learnt")


def _refuse(display: Display | None, message: str, code: int = USER_ERROR) -> int:
    if display is not None:
        display.close()
    print(f"ggwarp: {message}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
