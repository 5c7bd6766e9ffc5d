# SPDX-License-Identifier: Apache-2.0
"""Write the figures of README.md and docs/ that come from suites: benchmarks/suites/NAME.json has them.

    ggwarp suite built-in --device cpu --out suites/built-in
    python tools/results_page.py suites/built-in    # takes its suite.json, then writes the pages

In a page they stand between ``<!-- suite NAME: WHAT -->`` and ``<!-- end of suite -->``; WHAT is one of
:data:`WRITERS`.
"""

from __future__ import annotations

import re
import statistics
import sys
from collections.abc import Callable
from pathlib import Path

from ggwarp.suite.reporting.writers import markdown_table, note
from ggwarp.suite.results import Results, load_results

ROOT = Path(__file__).parents[1]
SUITES = ROOT / "benchmarks" / "suites"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]

BLOCK = re.compile(r"(<!-- suite (\S+): (\w+) -->\n).*?(<!-- end of suite -->)", re.DOTALL)
_SCANS, _CORES = 10_000, 64
"""What the example of a large suite asks for."""


def table(results: Results) -> str:
    """Return the papers' table."""
    return "\n".join([*markdown_table(results), "", note(results)])


def headline(results: Results) -> str:
    """Return how good the first setting is on the first sequence, in a sentence."""
    sequence, setting = results.sequences[0], results.settings[0]

    def figure(name: str, digits: int) -> str:
        mean = results.mean(sequence, setting, name)
        return "not measured" if mean is None else f"{mean.value:.{digits}f}"

    return (
        f"The built-in office, {figure('frames', 0)} frames on a CPU: trajectory error "
        f"{figure('ate_rmse_cm', 3)} cm, PSNR {figure('psnr', 1)} dB ({figure('heldout_psnr', 1)} dB of "
        f"frames that were never mapped), objects' mIoU {figure('miou', 2)}."
    )


def cost(results: Results) -> str:
    """Return what many such runs cost, from the core seconds that these took."""
    first = [run for run in results.runs if run.setting == results.settings[0] and run.status == "done"]
    frames = statistics.fmean(run.metrics["frames"] for run in first)
    seconds = statistics.fmean(run.cpu_s for run in first)
    hours = _SCANS * seconds / 3600.0
    return (
        f"A run of {frames:.0f} frames took {seconds:.0f} core seconds: {_SCANS:,} such scans are "
        f"{hours:.0f} core hours, {hours / _CORES:.1f} hours on {_CORES} cores."
    )


WRITERS: dict[str, Callable[[Results], str]] = {"table": table, "headline": headline, "cost": cost}


def written(text: str) -> str:
    """Return a page's ``text`` with the figures that are committed now."""

    def block(found: re.Match[str]) -> str:
        begin, name, what, end = found.groups()
        return f"{begin}{WRITERS[what](load_results(SUITES / f'{name}.json'))}\n{end}"

    return BLOCK.sub(block, text)


def main(folders: list[str]) -> None:
    """Take the results of suites' folders, and write the pages."""
    for folder in map(Path, folders):
        results = load_results(folder)
        results.write(SUITES / f"{results.name}.json")
    for page in PAGES:
        text = page.read_text()
        if (new := written(text)) != text:
            page.write_text(new)


if __name__ == "__main__":
    main(sys.argv[1:])
