# SPDX-License-Identifier: Apache-2.0
"""Kill runs at random moments, go on with them, and compare what they end with.

    python tests/reliability/kills.py --count 200 --seed 7

Half of the kills come at a random time, the others at a random one of the run's operations on files, which
hits the writing of checkpoints and results more often than any clock does. After each the earlier run in the
same place must be whole, or the new one in its place; then the run goes on by ``--resume``, or starts anew
where it had no checkpoint yet. A third are killed once more on their way. In the end every file must have the
bits of the run that was never stopped. Prints JSON: what was hit, and what was lost.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ggwarp.config.resumed_run import open_resumed
from ggwarp.config.run_config import ConfigError
from ggwarp.io.guarded import FileError
from ggwarp.results.checkpoints import find_run
from ggwarp.results.run_folder import OUTPUTS

FRAMES = 6
RUN = [
    *("--seq", "office", "--device", "cpu", "--scale", "0.08", "--frames", f"0:{3 * FRAMES}:3", "-q"),
    *("--mapper.iterations", "2", "--gicp.points", "1500", "--save-renders", "3", "--refine", "4"),
]
OLDER = [
    *("--seq", "office", "--device", "cpu", "--scale", "0.06", "--frames", "0:2", "-q"),
    *("--save-renders", "0"),
]
COMPARED = tuple(sorted({*OUTPUTS} - {"metrics.json", "frames.csv"}))
NOT_COMPARED = {
    *("fps", "wall_s", "tracking_ms", "mapping_ms", "refine_s", "peak_memory_mb"),
    *("latency_ms_p50", "latency_ms_p95", "loop_ms"),
}

_KILLER = """
import os, sys
place, left = sys.argv[1], int(sys.argv[2])
EVENTS = {"open", "os.rename", "os.remove", "os.rmdir", "os.mkdir", "shutil.rmtree", "shutil.move"}
def count():
    global left
    left -= 1
    if left < 0:
        os.kill(os.getpid(), 9)
def hook(event, values):
    if event in EVENTS and any(isinstance(v, (str, os.PathLike)) and place in os.fspath(v) for v in values):
        if event != "open" or values[2] & (os.O_WRONLY | os.O_RDWR):
            count()
fsync = os.fsync
os.fsync = lambda file: (count(), fsync(file))
sys.addaudithook(hook)
from ggwarp.run import main
code = main(sys.argv[3:])
print(left)
sys.exit(code)
"""
"""Runs the command, and kills it at the N-th operation on files of one folder that changes something."""


def outcome(folder: Path) -> dict[str, str]:
    """Return what must be the same of a run, by name."""
    found = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in COMPARED}
    figures = json.loads((folder / "metrics.json").read_text())
    kept = {name: value for name, value in figures.items() if name not in NOT_COMPARED}
    pictures = contents(folder / "renders")
    return found | {"metrics.json": json.dumps(kept), "renders": json.dumps(pictures)}


def contents(folder: Path) -> dict[str, str]:
    """Return every file of a folder with its checksum."""
    files = (p for p in sorted(folder.rglob("*")) if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


class Campaign:
    """Kills one run after another in a folder of its own."""

    def __init__(self, folder: Path, rng: random.Random) -> None:
        """Make the run that is never stopped, and the earlier run that has its place at first."""
        self.folder, self.rng = folder, rng
        self.hits: Counter[str] = Counter()
        self.lost: list[str] = []
        started = time.monotonic()
        most = 1_000_000
        whole = [str(folder), str(most), *RUN, "--out", str(folder / "whole"), "--checkpoint-every", "2"]
        self.operations = most - int(self._run(folder, whole, code=_KILLER).stdout.split()[-1])
        self.seconds = time.monotonic() - started
        self._run(folder, [*OLDER, "--out", str(folder / "older"), "--checkpoint-every", "off"])
        self._run(folder, [*OLDER, "--out", str(folder / "older-with-checkpoint")])
        self.whole = outcome(folder / "whole")

    def trial(self, number: int) -> None:
        """Kill a run, go on with it, and note what was lost."""
        place = self.folder / f"trial-{number}"
        out = place / "o"
        older = self.folder / self.rng.choice(["older", "older-with-checkpoint"])
        shutil.copytree(older, out)
        os.utime(out / "config.toml", (1_700_000_000, 1_700_000_000))  # it was there long before
        before = contents(out)
        every = self.rng.choice(["1", "2", "0.2s"])
        arguments = [*RUN, "--out", str(out)]
        for again in range(self.rng.choice([1, 1, 2])):
            frames = self._frames_behind(out)
            command = [*arguments, "--checkpoint-every", every]
            ended = self._killed(place, command)
            self._note(out, before, frames, ended, "again: " if again else "")
            arguments = self._next(out)
        done = self._run(place, arguments, check=False)
        if done.returncode:
            self._lose(place, f"{' '.join(arguments[:2])} ended with {done.returncode}: {done.stderr[-300:]}")
            return
        left = sorted(p.name for p in place.iterdir())
        if left != ["o"]:
            self._lose(place, f"left behind: {left}")
        for name, value in outcome(out).items():
            if value != self.whole[name]:
                self._lose(place, f"{name} is another")
        shutil.rmtree(place)

    def _killed(self, place: Path, arguments: Sequence[str]) -> str:
        """Run the command and kill it; return at what."""
        if self.rng.random() < 0.5:
            count = self.rng.randrange(self.operations)
            done = self._run(place, [str(place), str(count), *arguments], code=_KILLER, check=False)
            return "an operation on files" if done.returncode == -signal.SIGKILL else "nothing"
        command = [sys.executable, "-m", "ggwarp.run", *arguments]
        process = subprocess.Popen(command, cwd=place, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            process.wait(self.rng.uniform(0.0, 1.1 * self.seconds))
            return "nothing"
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            return "a time"

    def _note(self, out: Path, before: dict[str, str], frames: int, ended: str, again: str) -> None:
        """Note what a kill hit, and whether it has done any harm."""
        now, place = contents(out), out.parent
        stage = "the end" if now != before else self._stage(place)
        self.hits[f"{again}{ended}, {stage}"] += 1
        if now == before:
            return
        try:
            names = {*COMPARED} - {"object_scores.csv"}  # which is complete once pictures are compared
            reached = {name: now.get(name) for name in names}
            wanted = {name: value for name, value in self.whole.items() if name in names}
            if reached != wanted:
                self._lose(place, "the earlier run is no longer whole, nor is the new one in its place")
        finally:
            if frames > self._frames_behind(out):
                self._lose(place, "a checkpoint is gone")

    def _stage(self, place: Path) -> str:
        left = [p for p in place.glob(".o.*") if p.is_dir()]
        if not left:
            return "before the folder"
        names = {p.name for folder in left for p in folder.rglob("*")}
        if any(name.endswith(".safetensors") or ".safetensors." in name for name in names):
            half = any(name.endswith(".part") for name in names)
            return (
                "saving" if "trajectory.txt" in names else "a checkpoint half written" if half else "frames"
            )
        return "before the first checkpoint"

    def _frames_behind(self, out: Path) -> int:
        try:
            found = find_run(out)
            return 0 if found.folder == out and self._is_older(out) else open_resumed(out).done
        except (FileError, ConfigError):
            return 0

    def _is_older(self, out: Path) -> bool:
        return "0:2" in (out / "config.toml").read_text()

    def _next(self, out: Path) -> list[str]:
        """Return the command that goes on, or starts anew where there is nothing to go on from."""
        if self._frames_behind(out):
            return ["--resume", str(out), "-q"]
        return [*RUN, "--out", str(out)]

    def _run(
        self, place: Path, arguments: Sequence[str], *, code: str | None = None, check: bool = True
    ) -> subprocess.CompletedProcess[str]:
        program = ["-m", "ggwarp.run"] if code is None else ["-c", code]
        command = [sys.executable, *program, *arguments]
        return subprocess.run(command, cwd=place, capture_output=True, text=True, check=check)

    def _lose(self, place: Path, what: str) -> None:
        self.lost.append(f"{place.name}: {what}")
        print(self.lost[-1], file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a campaign and print its report; return 0 where nothing was lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where to work; default: a temporary folder")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        campaign = Campaign(Path(folder), random.Random(options.seed))
        for number in range(options.count):
            campaign.trial(number)
    report: dict[str, Any] = {
        "trials": options.count,
        "operations on files of a run": campaign.operations,
        "kills": sum(count for what, count in campaign.hits.items() if "nothing" not in what),
        "hits": dict(sorted(campaign.hits.items())),
        "lost": campaign.lost,
    }
    print(json.dumps(report, indent=2))
    return 1 if campaign.lost else 0


if __name__ == "__main__":
    sys.exit(main())
