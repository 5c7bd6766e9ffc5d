# SPDX-License-Identifier: Apache-2.0
"""One try of one run: in a process of its own, from its last checkpoint where there is one.

What is known of a run lies in the suite's folder alone: ``runs/NAME/`` is its run folder, ``runs/NAME.json``
its :class:`ggwarp.suite.job.JobRecord`, ``runs/NAME.log`` what it said. So any machine that sees the folder
can go on with it.
"""

from __future__ import annotations

import dataclasses
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import ggwarp
from ggwarp.datasets import is_there
from ggwarp.io.guarded import FileError
from ggwarp.io.lock import exclusive, in_use
from ggwarp.io.printable import printable, shortened
from ggwarp.results.checkpoints import checkpoint_files, find_run, kept_apart, leftovers
from ggwarp.suite.job import Attempt, Job, JobRecord, read_record
from ggwarp.suite.pool import Place

_LOOK = 0.05  # seconds between two looks at a run that goes on
_PATIENCE = 60.0  # seconds in which a run that shall stop has saved what it has
_USER_ERROR = 2


class Stopped(Exception):
    """The suite was stopped while a run went on."""


@dataclass(frozen=True)
class Site:
    """What all runs of a suite share.

    Attributes:
        folder: the suite's; every machine sees it under this name.
        mark: content of ``folder/.suite``, by which a machine knows that it sees the same folder.
        data: data root.
        device: of the runs, as ``--device`` has it.
        command: what a run's arguments are appended to; None: ``ggwarp run`` by :mod:`ggwarp.suite.child`.
        version: of ggwarp, which all machines must have.
    """

    folder: Path
    mark: str
    data: Path
    device: str = "auto"
    command: tuple[str, ...] | None = None
    version: str = ggwarp.__version__

    def run_folder(self, job: Job) -> Path:
        return self.folder / "runs" / job.name

    def record(self, job: Job) -> Path:
        return self.folder / "runs" / f"{job.name}.json"

    def log(self, job: Job) -> Path:
        return self.folder / "runs" / f"{job.name}.log"

    def options(self, job: Job) -> tuple[str, ...]:
        """Return what decides the job's results: the options of its run but those of this place."""
        return ("--seq", job.seq, "--device", self.device, *job.arguments)

    def check(self) -> None:
        """Refuse a machine that does not see the suite's folder, or has another ggwarp.

        Raises:
            OSError: it is such a machine.
        """
        if self.version != ggwarp.__version__:
            raise OSError(
                f"{socket.gethostname()} has ggwarp {ggwarp.__version__}, the suite was started with "
                f"{self.version}; install the same on all machines"
            )
        file = self.folder / ".suite"
        if not file.is_file() or file.read_text() != self.mark:
            raise OSError(
                f"{self.folder}: {socket.gethostname()} does not see this folder; "
                "give --out on storage that all machines share, under the same name"
            )


def known_record(site: Site, job: Job) -> JobRecord:
    """Return what became of the job; an empty record where nothing is known of such a run."""
    record = read_record(site.record(job))
    if record is None or record.command != site.options(job):
        return JobRecord(site.options(job))
    if record.status == "done" and not (site.run_folder(job) / "metrics.json").is_file():
        return JobRecord(site.options(job))  # somebody has removed it
    return record


def attempt(site: Site, job: Job, place: Place) -> JobRecord:
    """Do a run, or go on with what there is of it; return its record, which is written, too.

    A run of the job that still goes on, as its worker was lost and it was not, is waited for.

    Raises:
        OSError: this machine does not see the suite's folder, or it cannot be written to.
        Stopped: it is to stop before it has begun.
    """
    site.check()
    folder = site.run_folder(job)
    folder.parent.mkdir(parents=True, exist_ok=True)
    while any(in_use(path) for path in leftovers(folder.resolve())):
        _pause(place)
    record = known_record(site, job)
    if record.status == "done":
        return record
    if not record.attempts:
        _clear(folder)  # of another command
    if reason := fetch(site, job):
        record = dataclasses.replace(record, obstacle=reason)
        record.write(site.record(job))
        return record
    start = last_checkpoint(folder)
    if start is not None:
        record = _run(site, job, place, record, start)
        # A checkpoint that the run refuses is no reason to give up.
        if record.attempts[-1].exit_code != _USER_ERROR:
            return record
        _clear(folder)
    return _run(site, job, place, record, None)


def last_checkpoint(folder: Path) -> Path | None:
    """Return what ``--resume`` takes to go on with the run into ``folder``; None: it begins anew."""
    try:
        find_run(folder)
    except FileError:
        apart = [path for path in kept_apart(folder.resolve()) if checkpoint_files(path)]
        return apart[-1] if apart else None
    return folder


def fetch(site: Site, job: Job) -> str:
    """Have the sequence brought where it is not there; return why it cannot be had, empty: it is there.

    Raises:
        OSError: the data root cannot be written to.
    """
    if is_there(job.seq, site.data):
        return ""
    if not job.fetch:
        return f"{job.seq} is not under {site.data}"
    site.data.mkdir(parents=True, exist_ok=True)
    target = site.data / job.seq
    with exclusive(site.data / f".{target.name}.lock"):
        if is_there(job.seq, site.data):  # another run has brought it meanwhile
            return ""
        part = target.with_name(f".{target.name}.{os.getpid()}.part")
        part.mkdir(parents=True)
        filled = [word.replace("{seq}", job.seq) for word in shlex.split(job.fetch)]
        words = [word.replace("{folder}", str(part)) for word in filled]
        try:
            done = subprocess.run(words, capture_output=True, text=True, errors="replace", check=False)
            if done.returncode == 0 and any(part.iterdir()):
                part.rename(target)
                return ""
            said = done.stderr.strip().splitlines() or ["it brought nothing"]
            return f"fetching {job.seq} failed: {shortened(printable(said[-1]))}"
        except OSError as error:
            return f"fetching {job.seq} failed: {error.strerror}: {words[0]}"
        finally:
            shutil.rmtree(part, ignore_errors=True)


def _run(site: Site, job: Job, place: Place, record: JobRecord, start: Path | None) -> JobRecord:
    """Run it once, from the checkpoint of ``start`` or anew."""
    now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    record = record.tried(Attempt(now, socket.gethostname(), resumed=start is not None))
    record.write(site.record(job))
    out = site.run_folder(job)
    asked = site.options(job) if start is None else ("--resume", str(start))
    threads = str(job.resources.cpus)
    head = site.command or (sys.executable, "-m", "ggwarp.suite.child", str(os.getpid()), threads)
    environment = os.environ | dict(place.environment)
    environment |= {"OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads, "MKL_NUM_THREADS": threads}
    data = ("--data", str(site.data)) if site.data.is_dir() else ()  # built-in scenes need none
    command = [*head, *asked, *data, "--out", str(out)]
    began = time.perf_counter()
    with site.log(job).open("a") as log:
        print(f"\n== {now} {socket.gethostname()}: {shlex.join(command)}", file=log, flush=True)
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,  # Ctrl-C is the suite's, which then stops its runs
        )
        code, cpu_s = _waited(process, place.stopped)
    reason = "" if code == 0 else _said(site.log(job), code)
    record = record.ended(exit_code=code, wall_s=time.perf_counter() - began, cpu_s=cpu_s, reason=reason)
    record.write(site.record(job))
    return record


def _waited(process: subprocess.Popen[bytes], stopped: Callable[[], bool]) -> tuple[int, float | None]:
    """Return the exit code of ``process`` and the seconds of all cores it took; once stopped, it is ended."""
    asked_at: float | None = None
    try:
        while True:
            ended = _ended(process)
            if ended is not None:
                return ended
            if asked_at is None and stopped():
                asked_at = time.monotonic()
                process.terminate()
            elif asked_at is not None and time.monotonic() - asked_at > _PATIENCE:
                process.kill()
            time.sleep(_LOOK)
    except BaseException:  # Ray's way of stopping a task
        process.terminate()
        try:
            process.wait(_PATIENCE)
        finally:
            process.kill()
        raise


def _ended(process: subprocess.Popen[bytes]) -> tuple[int, float | None] | None:
    if not hasattr(os, "wait4"):
        code = process.poll()
        return None if code is None else (code, None)
    pid, status, usage = os.wait4(process.pid, os.WNOHANG)
    if pid == 0:
        return None
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, usage.ru_utime + usage.ru_stime


def _said(log: Path, code: int) -> str:
    """Return why a run failed, in one line: what it said last, or the signal that ended it."""
    if code < 0:
        try:
            return f"killed by {signal.Signals(-code).name}"
        except ValueError:
            return f"killed by signal {-code}"
    with log.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - 4096))
        lines = file.read().decode(errors="replace").splitlines()
    spoken = [line.strip() for line in lines if line.strip() and not line.startswith("==")]
    errors = [line for line in spoken if line.startswith("ggwarp: ")]
    line = (errors or spoken or ["no reason given"])[-1].removeprefix("ggwarp: ")
    return f"exit code {code}: {shortened(printable(line), 200)}"


def _pause(place: Place) -> None:
    if place.stopped():
        raise Stopped
    time.sleep(10.0 * _LOOK)


def _clear(folder: Path) -> None:
    """Remove what there is of a run into ``folder``."""
    real = folder.resolve()
    for path in (real, *leftovers(real), *kept_apart(real)):
        shutil.rmtree(path, ignore_errors=True)
