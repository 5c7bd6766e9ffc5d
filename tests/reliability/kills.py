# SPDX-License-Identifier: Apache-2.0
"""Kill runs at random moments, go on with them, and compare what they end with.

    python tests/reliability/kills.py --count 200 --seed 7

Two thirds of the kills come at a random moment within one of the run's stages, most stages as often as any
other, the rest at a random one of its operations on files. After each the earlier run in the same place must
be whole, or the new one in its place, and no frame of a checkpoint may be gone; then the run goes on by
``--resume``, or starts anew where it had no checkpoint yet. A third are killed once more on their way. In the
end every file must have the bits of the run that was never stopped. Prints JSON: what was hit, and what lost.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import hashlib
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from killed_run import Watch, install

import ggwarp.session  # noqa: F401 - imported once, for every run that is forked
from ggwarp import run
from ggwarp.config.resumed_run import open_resumed
from ggwarp.config.run_config import ConfigError
from ggwarp.io.guarded import FileError
from ggwarp.results.checkpoints import find_run
from ggwarp.results.run_folder import OUTPUTS

RUN = [
    *("--seq", "office", "--device", "cpu", "--scale", "0.08", "--frames", "0:15:3", "-q"),
    *("--mapper.iterations", "2", "--gicp.points", "1500", "--save-renders", "3", "--refine", "4"),
]
OLDER = [
    *("--seq", "office", "--device", "cpu", "--scale", "0.06", "--frames", "0:2", "-q"),
    *("--save-renders", "0"),
]
COMPARED = tuple(sorted({*OUTPUTS} - {"metrics.json", "frames.csv", "report.html"}))
NOT_COMPARED = {
    *("fps", "wall_s", "tracking_ms", "mapping_ms", "refine_s", "peak_memory_mb"),
    *("latency_ms_p50", "latency_ms_p95", "loop_ms"),
    "warnings",  # a killed run was warned of other things
}

STAGES = ("open", "track", "map", "checkpoint", "refine", "save", "evaluate")
"""Of a run whose program and kernels are there; import and compile take long, and are killed more seldom."""

_UNSEEN = {"import": 1.5, "compile": 12.0}
"""Seconds within which a run is killed in stages that the run that is never stopped does not have."""

_PROGRAM = Path(__file__).with_name("killed_run.py")


@dataclass(frozen=True)
class Moment:
    """When a run is killed: see ``killed_run.py``.

    Attributes:
        stage: in which; "file": at an operation on files; "never".
        count: the how manieth time that the stage is entered, or operation, from 1.
        delay: seconds after that.
    """

    stage: str = "never"
    count: int = 1
    delay: float = 0.0


@dataclass
class Killed:
    """What a run had done when it ended.

    Attributes:
        stage: that it was in.
        frames: of its last checkpoint.
        code: its exit code.
        counts: how often each stage was entered; of operations on files, how many there were.
        seconds: the longest time in each.
    """

    stage: str
    frames: int
    code: int
    counts: dict[str, int]
    seconds: dict[str, float]


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
        self.trials = 0
        stages = [*STAGES * 3, "import", "compile"]
        self._stages = rng.sample(stages, len(stages))
        self.hits: Counter[str] = Counter()
        self.ways: Counter[str] = Counter()
        self.lost: list[str] = []
        whole = [*RUN, "--out", str(folder / "whole"), "--checkpoint-every", "2"]
        self.typical = self._killed(folder, whole, Moment())
        self._forked(folder, [*OLDER, "--out", str(folder / "older"), "--checkpoint-every", "off"])
        self._forked(folder, [*OLDER, "--out", str(folder / "older-with-checkpoint")])
        self.whole = outcome(folder / "whole")

    def trial(self) -> None:
        """Kill a run, go on with it, and note what was lost."""
        place = self.folder / f"trial-{self.trials}"
        out = place / "o"
        older = self.folder / self.rng.choice(["older", "older-with-checkpoint"])
        shutil.copytree(older, out)
        os.utime(out / "config.toml", (1_700_000_000, 1_700_000_000))  # it was there long before
        before = contents(out)
        every = self.rng.choice(["1", "2", "0.2s"])
        arguments = [*RUN, "--out", str(out)]
        moments = [self._moment(self._stages[self.trials % len(self._stages)])]
        self.trials += 1
        if self.rng.random() < 1 / 3:
            moments.append(self._moment(self.rng.choice(STAGES)))
        cache = {"WARP_CACHE_PATH": str(place / "kernels")} if moments[0].stage == "compile" else {}
        for moment in moments:
            behind = self._frames_behind(out)
            killed = self._killed(place, [*arguments, "--checkpoint-every", every], moment, cache)
            self.hits[killed.stage if killed.code == -signal.SIGKILL else "not killed"] += 1
            self._check(out, before, max(behind, killed.frames))
            arguments = self._next(out)
        self.ways["went on" if "--resume" in arguments else "started anew"] += 1
        if cache:
            done = self._run(place, ["-m", "ggwarp.run", *arguments], cache)
        else:
            done = self._forked(place, arguments)
        if done.returncode:
            self._lose(place, f"{' '.join(arguments[:2])} ended with {done.returncode}: {done.stderr[-300:]}")
            return
        left = {p.name for p in place.iterdir()} - {"o", "kernels"}
        if left:
            self._lose(place, f"left behind: {left}")
        for name, value in outcome(out).items():
            if value != self.whole[name]:
                self._lose(place, f"{name} is another")
        shutil.rmtree(place)

    def _moment(self, stage: str) -> Moment:
        typical = self.typical
        if stage not in _UNSEEN and self.rng.random() < 1 / 3:
            return Moment("file", self.rng.randint(1, typical.counts["file"]))
        count = self.rng.randint(1, max(1, typical.counts.get(stage, 1)))
        seconds = _UNSEEN.get(stage) or typical.seconds[stage]
        return Moment(stage, count, self.rng.uniform(0.0, seconds))

    def _killed(
        self, place: Path, arguments: Sequence[str], moment: Moment, environment: dict[str, str] | None = None
    ) -> Killed:
        """Run the command and kill it; return what it was doing."""
        told = place.with_name(f"{place.name}.told")
        if moment.stage in ("import", "compile"):
            when = [moment.stage, str(moment.count), repr(moment.delay)]
            command = [str(_PROGRAM), str(place), str(told), *when, *arguments]
            done = self._run(place, command, environment or {})
        else:
            done = self._forked(place, arguments, lambda: Watch(told, **dataclasses.asdict(moment)))
        if done.returncode not in (0, -signal.SIGKILL):
            self._lose(place, f"ended with {done.returncode}: {done.stderr[-300:]}")
        lines = told.read_text().split("\n") if told.exists() else ["import", "0", ""]
        told.unlink(missing_ok=True)
        counts, seconds = json.loads(lines[2] or "[{}, {}]")
        return Killed(lines[0].strip(), int(lines[1]), done.returncode, counts, seconds)

    def _check(self, out: Path, before: dict[str, str], frames: int) -> None:
        """Note whether a kill has done any harm; ``frames``: of the last checkpoint."""
        now, place = contents(out), out.parent
        if now == before:
            self.ways["the earlier run was whole"] += 1
        else:
            names = {*COMPARED} - {"object_scores.csv"}  # which is complete once pictures are compared
            if any(now.get(name) != self.whole[name] for name in names):
                self._lose(place, "the earlier run is no longer whole, nor is the new one in its place")
            self.ways["the new run was in its place"] += 1
        if frames > self._frames_behind(out):
            self._lose(place, f"a checkpoint is gone: {self._frames_behind(out)} of {frames} frames")

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
        self, place: Path, command: Sequence[str], environment: dict[str, str]
    ) -> subprocess.CompletedProcess[str]:
        """Run a program of Python's in ``place``."""
        variables = {**os.environ, **environment}
        return subprocess.run(
            [sys.executable, *command], cwd=place, capture_output=True, text=True, check=False, env=variables
        )

    def _forked(
        self, place: Path, arguments: Sequence[str], watch: Callable[[], Watch] | None = None
    ) -> subprocess.CompletedProcess[str]:
        """Run the command in a process like this one, which has imported all: most of a small run's time."""
        said = place.with_name(f"{place.name}.said")
        child = os.fork()
        if not child:
            code = 70
            try:
                os.chdir(place)
                file = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
                os.dup2(file, 1)
                os.dup2(file, 2)
                watching = None if watch is None else watch()
                if watching is not None:
                    install(watching, str(place))
                code = run.main(list(arguments))
                if watching is not None:
                    watching.tell(json.dumps([watching.counts, watching.seconds]))
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
        _, status = os.waitpid(child, 0)
        text = said.read_text(errors="replace")
        said.unlink()
        return subprocess.CompletedProcess(arguments, os.waitstatus_to_exitcode(status), "", text)

    def _lose(self, place: Path, what: str) -> None:
        self.lost.append(f"{place.name}: {what}")
        print(self.lost[-1], file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a campaign and print its report; return 0 where nothing was lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=math.inf, help="begin no trial after so many")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where to work; default: a temporary folder")
    options = parser.parse_args(arguments)
    began = time.monotonic()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        campaign = Campaign(Path(folder), random.Random(options.seed))
        with contextlib.suppress(KeyboardInterrupt):  # what was tried until then is told
            while campaign.trials < options.count and time.monotonic() - began < options.seconds:
                campaign.trial()
    report: dict[str, Any] = {
        "trials": campaign.trials,
        "operations on files of a run": campaign.typical.counts["file"],
        "kills": sum(count for what, count in campaign.hits.items() if what != "not killed"),
        "in": dict(campaign.hits),
        "ways": dict(campaign.ways),
        "lost": campaign.lost,
    }
    print(json.dumps(report, indent=2))
    return 1 if campaign.lost else 0


if __name__ == "__main__":
    sys.exit(main())
