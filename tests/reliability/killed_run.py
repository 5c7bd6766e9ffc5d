# SPDX-License-Identifier: Apache-2.0
"""Runs the command, and kills it at a given moment.

    killed_run.py PLACE TOLD STAGE COUNT DELAY ARGUMENTS...

``TOLD`` is a file that has, whenever the program ends, the stage that it is in and the frames of its last
checkpoint, a line each; and where it was not killed, how often stages were entered, and how long they took.
``STAGE`` is "file" for the operations on files in ``PLACE`` that change something.
"""

from __future__ import annotations

import functools
import json
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

EVENTS = {"open", "os.rename", "os.remove", "os.rmdir", "os.mkdir", "shutil.rmtree", "shutil.move"}


class Watch:
    """Knows the stage that the program is in, writes it down, and ends the program when it is time."""

    def __init__(self, told: Path, stage: str, count: int, delay: float) -> None:
        self._file = os.open(told, os.O_RDWR | os.O_CREAT)
        self._fatal, self._count, self._delay = stage, count, delay
        self._stages: list[str] = []
        self.frames = 0
        self.counts: Counter[str] = Counter()
        self.seconds: dict[str, float] = {}

    def count(self, stage: str, delay: float) -> None:
        self.counts[stage] += 1
        if stage == self._fatal and self.counts[stage] == self._count:
            if not delay:
                self.kill()
            timer = threading.Timer(delay, self.kill)
            timer.daemon = True
            timer.start()

    def kill(self) -> None:
        os.kill(os.getpid(), 9)

    def enter(self, stage: str) -> None:
        self._stages.append(stage)
        self.tell()
        self.count(stage, self._delay)

    def leave(self, began: float) -> None:
        stage = self._stages.pop()
        self.seconds[stage] = max(self.seconds.get(stage, 0.0), time.monotonic() - began)
        self.tell()

    def tell(self, more: str = "") -> None:
        stage = self._stages[-1] if self._stages else "between"
        os.pwrite(self._file, f"{stage:12}\n{self.frames:8}\n{more}".encode(), 0)

    def within(self, owner: Any, name: str, stage: str) -> None:
        """Have every call of a function be ``stage``."""
        function: Callable[..., Any] = getattr(owner, name)

        @functools.wraps(function)
        def watched(*arguments: Any, **options: Any) -> Any:
            began = time.monotonic()
            self.enter(stage)
            try:
                result = function(*arguments, **options)
                if stage == "checkpoint" and arguments[0]._written is not None:
                    self.frames = arguments[0]._written[0]
                return result
            finally:
                self.leave(began)

        setattr(owner, name, watched)


def install(watch: Watch, place: str) -> None:
    """Have ``watch`` see the stages of a run, and its operations on files in ``place``."""
    from ggwarp import session
    from ggwarp.checkpointing import Checkpoints
    from ggwarp.pipeline.slam import Slam

    def hook(event: str, values: tuple[Any, ...]) -> None:
        if event in EVENTS and any(isinstance(v, (str, os.PathLike)) and place in str(v) for v in values):
            if event != "open" or values[2] & (os.O_WRONLY | os.O_RDWR):
                watch.count("file", 0.0)

    def synchronise(file: int, fsync: Callable[[int], None] = os.fsync) -> None:
        watch.count("file", 0.0)
        fsync(file)

    os.fsync = synchronise
    sys.addaudithook(hook)
    for owner, name, what in (
        (session.Session, "open", "open"),
        (session.Session, "prepare", "prepare"),
        (session, "load_kernels", "compile"),
        (session.Session, "track_and_map", "frames"),
        (Slam, "track_frame", "track"),
        (Slam, "map_frame", "map"),
        (Checkpoints, "write", "checkpoint"),
        (Slam, "refine", "refine"),
        (session.Session, "save", "save"),
        (session.Session, "evaluate", "evaluate"),
    ):
        watch.within(owner, name, what)


def main() -> int:
    place, told, stage, count, delay, *arguments = sys.argv[1:]
    watch = Watch(Path(told), stage, int(count), float(delay))
    began = time.monotonic()
    watch.enter("import")

    from ggwarp import run

    install(watch, place)
    watch.leave(began)
    code = run.main(arguments)
    watch.tell(json.dumps([watch.counts, watch.seconds]))
    return code


if __name__ == "__main__":
    sys.exit(main())
