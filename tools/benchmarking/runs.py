# SPDX-License-Identifier: Apache-2.0
"""Runs of the command, each in a process of its own, and what they measured."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SYNCHRONOUS = "none"
"""The cap of a run that is not live."""

FRAME_COLUMNS = ("index", "tracking_ms", "mapping_ms", "mapping_iterations", "late_ms", "gaussians")
"""What is taken of ``frames.csv``."""

_TOOLS = Path(__file__).parents[1]


@dataclass(frozen=True)
class RunSpec:
    """One run.

    Attributes:
        fps: frames a second at which frames arrive, or what else ``--fps`` takes; "none": synchronous.
        The others: as the command's options.
    """

    seq: str
    preset: str = "gg-slam"
    fps: str = SYNCHRONOUS
    frames: str | None = None
    scale: float | None = None
    data: Path | None = None
    device: str = "auto"

    @property
    def label(self) -> str:
        cap = "" if self.fps == SYNCHRONOUS else f" --fps {self.fps}"
        return f"{self.seq} {self.preset}{cap}"

    def arguments(self, out: Path) -> list[str]:
        """Return the command's options."""
        given = {"frames": self.frames, "scale": self.scale, "data": self.data}
        given["fps"] = None if self.fps == SYNCHRONOUS else self.fps
        options = ["--seq", self.seq, "--preset", self.preset, "--device", self.device, "--out", str(out)]
        for name, value in given.items():
            if value is not None:
                options += [f"--{name}", str(value)]
        return [*options, "--save-renders", "0"]


@dataclass(frozen=True)
class Outcome:
    """What a run gave.

    Attributes:
        metrics: of its ``metrics.json``.
        stages: seconds in tracking, insertion and mapping.
        frames: the rows of its ``frames.csv`` that were processed, numbers by column.
        failure: why it gave nothing; "" when it did.
    """

    metrics: dict[str, Any] = field(default_factory=dict)
    stages: dict[str, float] = field(default_factory=dict)
    frames: list[dict[str, float]] = field(default_factory=list)
    failure: str = ""

    def metric(self, name: str) -> float | None:
        return self.metrics.get(name)

    @property
    def late_ms(self) -> list[float]:
        """How late each frame was taken up."""
        return [row["late_ms"] for row in self.frames]

    @property
    def loop_s(self) -> float | None:
        """Seconds from the first frame to the last one's end."""
        fps = self.metric("fps")
        return self.metrics["frames"] / fps if fps else None

    @property
    def shares(self) -> dict[str, float | None]:
        """Stage -> share of the loop's time; rest: reading, waiting, deciding."""
        loop = self.loop_s
        shares: dict[str, float | None] = {
            stage: seconds / loop if loop else None for stage, seconds in self.stages.items()
        }
        known = [share for share in shares.values() if share is not None]
        shares["rest"] = max(0.0, 1.0 - sum(known)) if known else None
        return shares


def execute(spec: RunSpec) -> Outcome:
    """Run the command in a process of its own, in a folder that is then removed."""
    print(f"running {spec.label}", file=sys.stderr, flush=True)
    path = os.pathsep.join([str(_TOOLS), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"PYTHONPATH": path}
    with tempfile.TemporaryDirectory() as name:
        folder, times = Path(name) / "run", Path(name) / "times.json"
        command = [sys.executable, "-m", "benchmarking.timed_run", str(times), *spec.arguments(folder)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            said = done.stderr.strip().splitlines() or ["no reason given"]
            return Outcome(failure=f"{spec.label}: exit code {done.returncode}: {said[-1]}")
        with (folder / "frames.csv").open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["verdict"] != "skipped"]
        frames = [{name: float(row[name]) for name in FRAME_COLUMNS} for row in rows]
        metrics = json.loads((folder / "metrics.json").read_text())
        return Outcome(metrics, json.loads(times.read_text()), frames)
