# SPDX-License-Identifier: Apache-2.0
"""A suite from its file to its tables: what is missing is run, what broke is tried once more."""

from __future__ import annotations

import contextlib
import functools
import os
import secrets
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from ggwarp.console import Display
from ggwarp.io.lock import lock_folder
from ggwarp.suite.attempts import Site, attempt, known_record
from ggwarp.suite.definition import Suite, SuiteError
from ggwarp.suite.job import Attempt, Job, JobRecord
from ggwarp.suite.pool import Pool
from ggwarp.suite.results import Results, gather

TRIES = 2
"""How often a start of the suite tries a run."""

_SAVED_EVERY = 30.0  # seconds between two times that results are written on the way


def open_site(
    folder: Path, *, data: Path, device: str = "auto", command: tuple[str, ...] | None = None
) -> Site:
    """Return the site of a suite in ``folder``, which is made, or has been a suite's.

    Raises:
        SuiteError: it holds something else.
        OSError: it cannot be made.
    """
    mark = folder / ".suite"
    if folder.exists() and not folder.is_dir():
        raise SuiteError(f"--out {folder}: is no folder; name another")
    if folder.is_dir() and not mark.is_file() and any(folder.iterdir()):
        raise SuiteError(f"--out {folder}: holds other files and no suite; name a new folder")
    folder.mkdir(parents=True, exist_ok=True)
    if not mark.is_file():
        mark.write_text(secrets.token_hex(16))
    return Site(folder.resolve(), mark.read_text(), data.absolute(), device, command)


def execute(
    suite: Suite,
    site: Site,
    pool: Pool,
    display: Display,
    *,
    save: Callable[[Results], None] = lambda results: None,
    tries: int = TRIES,
) -> Results:
    """Do all runs of ``suite`` that are not done, and return what is measured by then.

    A run that fails is said and tried again when all others have been; none ends the others.

    Args:
        save: called with the results now and then, and at the end, also of a suite that is stopped.

    Raises:
        SuiteError: another program is at work in the suite's folder.
        OSError: it cannot be written to.
    """
    with _alone_in(site.folder):
        return _execute(suite, site, pool, display, save, tries)


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    try:
        lock = lock_folder(folder)
    except OSError:
        raise SuiteError(
            f"{folder}: another ggwarp suite is at work there; wait for it, or stop it"
        ) from None
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)


def _execute(
    suite: Suite, site: Site, pool: Pool, display: Display, save: Callable[[Results], None], tries: int
) -> Results:
    records = {job: known_record(site, job) for job in suite.jobs()}
    waiting = [job for job, record in records.items() if record.status != "done"]
    before = len(records) - len(waiting)
    display.note(
        f"{suite.name}: {len(records)} runs{f', {before} done before' if before else ''}, {pool.about}; "
        f"results in {site.folder}"
    )
    try:
        for again in range(tries):
            if not waiting:
                break
            display.stage("runs once more" if again else "runs", len(waiting))
            saved_at = time.monotonic()
            with contextlib.closing(pool.run(functools.partial(attempt, site), waiting)) as found:
                for job, result in found:
                    lost = not isinstance(result, JobRecord)
                    records[job] = _lost(known_record(site, job), result) if lost else result
                    _show(job, records[job], display)
                    if time.monotonic() - saved_at > _SAVED_EVERY:
                        save(gather(suite, site, records))
                        saved_at = time.monotonic()
            waiting = [job for job in waiting if _tried_in_vain(records[job])]
    finally:
        display.close()
        # Of those that go on when the suite is stopped, some may yet be done.
        begun = [job for job in waiting if not records[job].attempts and not records[job].obstacle]
        records |= {job: known_record(site, job) for job in begun}
        results = gather(suite, site, records)
        save(results)
    return results


def _tried_in_vain(record: JobRecord) -> bool:
    return record.status != "done" and not record.obstacle


def _lost(record: JobRecord, error: Exception) -> JobRecord:
    """Return the record of a job whose worker broke down, and not its run."""
    reason = str(error) or type(error).__name__
    if not record.attempts:
        now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        return record.tried(Attempt(now, "", reason=reason))
    return record.ended(reason=reason)


def _show(job: Job, record: JobRecord, display: Display) -> None:
    seconds = record.attempts[-1].wall_s if record.attempts else None
    took = "" if seconds is None else f" in {seconds:.0f} s"
    if record.status == "done":
        display.note(f"{job.label}: done{took}")
    else:
        display.warn(f"{job.label}: {record.status}{took}: {record.reason or 'it was stopped'}")
    display.advance(f"{job.label}: {record.status}")
