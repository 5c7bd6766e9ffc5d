# SPDX-License-Identifier: Apache-2.0
"""Run every sequence with every setting, each run in a process of its own, and print the papers' tables.

ggwarp suite built-in                       # shipped: replica, tum, scannet, built-in, choose
ggwarp suite mine.toml --out suites/mine    # again: does what is missing
ggwarp suite mine.toml --compare suites/old # what differs, and whether that is more than chance
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from ggwarp.console import Verbosity, open_display
from ggwarp.interruption import Interruption
from ggwarp.io.printable import printable
from ggwarp.suite.attempts import Site, known_record
from ggwarp.suite.choosing import choose, write_choice
from ggwarp.suite.definition import SHIPPED, Choice, Suite, SuiteError
from ggwarp.suite.execution import execute, open_site
from ggwarp.suite.job import Resources
from ggwarp.suite.pool import LocalPool, Pool, cores
from ggwarp.suite.reporting.comparison import compare
from ggwarp.suite.reporting.files import write_files
from ggwarp.suite.results import Results, load_results
from ggwarp.suite.suite_file import load_suite

DONE, FAILED, USER_ERROR = 0, 1, 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code.

    0: all is done but what has no data here; 1: a run failed, or none could be done; 2: the user's mistake;
    130, 143, 129: a signal ended it, and the same command goes on.
    """
    options = _parser().parse_args(arguments)
    with Interruption() as interruption:
        try:
            return _main(options)
        except SuiteError as error:
            return _refuse(str(error), USER_ERROR)
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            return _refuse(f"{where}{error.strerror or error}", USER_ERROR)
        except KeyboardInterrupt:
            return _refuse("stopped; the same command goes on", interruption.exit_code)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ggwarp suite",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    shipped = ", ".join(sorted(path.stem for path in SHIPPED.glob("*.toml")))
    parser.add_argument("suite", help=f"a TOML file, or one that is shipped: {shipped}")
    parser.add_argument("--out", type=Path, help="the suite's folder (suites/NAME); one of its own goes on")
    parser.add_argument("--data", type=Path, help="data root (default: $GGWARP_DATA, else ./data)")
    parser.add_argument("--device", default="auto", help="of every run: auto, cpu or cuda:N")
    parser.add_argument("--seq", nargs="+", help="these sequences instead of the suite's")
    parser.add_argument("--jobs", type=int, help="runs at a time at most (what cores and memory hold)")
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="run on a Ray cluster: auto, or its address (pip install 'ggwarp[cluster]')",
    )
    parser.add_argument(
        "--compare", type=Path, metavar="OLD", help="compare with another suite's folder or its suite.json"
    )
    parser.add_argument(
        "--within",
        type=float,
        metavar="DB",
        help="choose the fastest setting whose PSNR is so near the best",
    )
    parser.add_argument("--list", action="store_true", help="say what would be run, and run nothing")
    return parser


def _main(options: argparse.Namespace) -> int:
    suite = load_suite(options.suite)
    if options.seq:
        suite = suite.of_sequences(options.seq)
    if options.within is not None:
        suite = dataclasses.replace(suite, choice=Choice(options.within))
    suite.check()
    if options.jobs is not None and options.jobs < 1:
        raise SuiteError(f"--jobs {options.jobs}: give 1 or more")
    if options.ray is not None and options.device.startswith("cuda"):
        raise SuiteError(f"--device {options.device}: Ray hands out GPUs; leave it at auto, or give cpu")
    earlier = None if options.compare is None else load_results(options.compare)
    folder = options.out or Path("suites") / suite.name
    data = options.data or Path(os.environ.get("GGWARP_DATA") or "data")
    site = open_site(folder, data=data, device=options.device)
    if options.list:
        return _list(suite, site)
    suite = dataclasses.replace(suite, resources=_resources(suite, options))
    display = open_display(Verbosity.NORMAL)
    one_gpu = 1 if options.device.startswith("cuda") else None
    pool = open_pool(suite.resources, address=options.ray, most=options.jobs or one_gpu)
    save = functools.partial(write_files, folder=folder)
    results = execute(suite, site, pool, display, save=save)
    comparison = None
    if earlier is not None:
        comparison = compare(results, earlier, str(options.compare))
        write_files(results, folder=folder, comparison=comparison)
        for row in comparison.rows:
            display.note(row.line)
        display.note(comparison.note)
    if suite.choice is not None and results.count("done"):
        chosen = choose(results, suite.choice)
        write_choice(suite, chosen, folder / "chosen.toml")
        display.note(f"chosen: {chosen.line}; ggwarp run --config {folder / 'chosen.toml'}")
    return _conclude(results, folder, display.conclude)


def _resources(suite: Suite, options: argparse.Namespace) -> Resources:
    """Return what one run is given: all cores where speeds decide; no GPU where the user says which."""
    found = suite.resources
    if options.device != "auto":
        found = dataclasses.replace(found, gpus=0.0)
    if suite.choice is not None and options.ray is None:
        found = dataclasses.replace(found, cpus=cores())
    return found


def open_pool(resources: Resources, *, address: str | None, most: int | None) -> Pool:
    """Return this machine's pool, or with an ``address`` that of a Ray cluster.

    Raises:
        SuiteError: there is no such cluster, or it can never hold a run.
    """
    if address is None:
        return LocalPool(resources, most=most)
    from ggwarp.suite.ray_pool import RayPool

    return RayPool(resources, address=address, most=most)


def _conclude(results: Results, folder: Path, say: Callable[[str], None]) -> int:
    done, failed = results.count("done"), results.count("failed")
    undone = len(results.runs) - done - failed
    parts = [f"{done} done"] + [f"{failed} failed"] * bool(failed) + [f"{undone} not run"] * bool(undone)
    say(f"{', '.join(parts)}; tables in {folder / 'index.html'}")
    return FAILED if failed or not done else DONE


def _list(suite: Suite, site: Site) -> int:
    for job in suite.jobs():
        record = known_record(site, job)
        print(printable(f"{job.name}: {record.status}{f', {record.reason}' if record.reason else ''}"))
    return DONE


def _refuse(message: str, code: int) -> int:
    print(f"ggwarp suite: {printable(message)}", file=sys.stderr)
    return code
