# SPDX-License-Identifier: Apache-2.0
"""Where a frame's time goes: the host's functions, and the device's kernels one by one.

    python -m gpu_day.frame_profile FOLDER [--preset gg-slam] [--warm 12] [--frames 8] [--device cuda:0]

Frames are tracked and mapped in turn: first timed as they are, then with Python's profiler (whose own cost
is in its figures), and last with recordings taken apart, so that each kernel is timed by itself.
"""

from __future__ import annotations

import argparse
import cProfile
import io
import pstats
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from ggwarp import FrameReader, Slam
from ggwarp.config.presets import preset_config
from ggwarp.datasets import BadFrame, open_dataset
from ggwarp.runtime import loading
from ggwarp.runtime.graphs import GraphCache
from ggwarp.types import Frame

_LINES = 45


class FrameProfile:
    """A run that is looked at while it goes on; frames come from ``frames``."""

    def __init__(self, slam: Slam, frames: Iterator[Frame], device: Any) -> None:
        self._slam, self._frames, self._device = slam, frames, device

    def times(self, count: int) -> dict[str, list[float]]:
        """Track and map frames; return the wall time of each, ms, ordinary frames and keyframes apart."""
        found: dict[str, list[float]] = defaultdict(list)
        for _ in range(count):
            started = time.perf_counter()
            tracked = self._slam.track_frame(next(self._frames))
            wp.synchronize_device(self._device)
            between = time.perf_counter()
            self._slam.map_frame(tracked)
            wp.synchronize_device(self._device)
            kind = "keyframe" if tracked.is_keyframe else "frame"
            found[f"{kind}: tracking"].append(1e3 * (between - started))
            found[f"{kind}: mapping"].append(1e3 * (time.perf_counter() - between))
        return found

    def functions(self, count: int, order: str) -> str:
        """Return the profiler's table of ``count`` frames, by ``order``."""
        profile = cProfile.Profile()
        profile.enable()
        self.times(count)
        profile.disable()
        text = io.StringIO()
        stats = pstats.Stats(profile, stream=text).strip_dirs()
        stats.sort_stats(order).print_stats(_LINES)
        return text.getvalue()

    def kernels(self, count: int) -> list[tuple[str, int, float]]:
        """Return each activity of the device in ``count`` frames: name, how often, milliseconds in all."""
        recorded = GraphCache.run

        def direct(_: GraphCache, variant: Any, work: Callable[[], None], *, arrays: Any) -> None:
            work()

        try:
            GraphCache.run = direct  # type: ignore[method-assign]
            wp.timing_begin(wp.TIMING_ALL)
            self.times(count)
            activities = wp.timing_end()
        finally:
            GraphCache.run = recorded  # type: ignore[method-assign]
        spent: dict[str, list[float]] = defaultdict(list)
        for activity in activities:
            spent[activity.name].append(activity.elapsed)
        rows = [(name, len(ms), float(np.sum(ms))) for name, ms in spent.items()]
        return sorted(rows, key=lambda row: -row[2])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m gpu_day.frame_profile", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("folder", help="a recording, as --seq takes it")
    parser.add_argument("--preset", default="gg-slam", help="as ggwarp run takes it")
    parser.add_argument("--warm", type=int, default=12, help="frames before any is measured")
    parser.add_argument("--frames", type=int, default=8, help="frames of each of the three looks")
    parser.add_argument("--device", default="cuda:0")
    options = parser.parse_args(arguments)
    loading.init_quietly()
    config = preset_config(options.preset).slam
    dataset = open_dataset(options.folder, data_root=Path())
    wanted = range(min(options.warm + 4 * options.frames, len(dataset)))
    with FrameReader(dataset, wanted, scale=1.0) as reader:
        frames = (frame for frame in reader if not isinstance(frame, BadFrame))
        first = next(frames)
        slam = Slam(config, reader.camera, reader.sensor_camera, device=options.device)
        slam.step(first)
        profile = FrameProfile(slam, frames, options.device)
        profile.times(options.warm - 1)
        for name, ms in sorted(profile.times(options.frames).items()):
            print(f"{name}: median {np.median(ms):.1f} ms, {', '.join(f'{v:.1f}' for v in ms)}")
        print(f"{slam.map.count} Gaussians")
        print(profile.functions(options.frames, "tottime"))
        print(profile.functions(options.frames, "cumulative"))
        total = 0.0
        for name, often, ms in (rows := profile.kernels(options.frames)):
            total += ms
            print(f"{ms / options.frames:9.3f} ms a frame {often / options.frames:7.1f} times  {name}")
        print(f"{total / options.frames:9.3f} ms a frame in all, {len(rows)} activities")
    return 0


if __name__ == "__main__":
    sys.exit(main())
