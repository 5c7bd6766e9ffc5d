# SPDX-License-Identifier: Apache-2.0
"""Everything that a suite's folder has beside its runs."""

from __future__ import annotations

from pathlib import Path

from ggwarp.suite.reporting.comparison import Comparison
from ggwarp.suite.reporting.page import write_page
from ggwarp.suite.reporting.writers import write_csv, write_latex, write_markdown
from ggwarp.suite.results import Results


def write_files(results: Results, folder: Path, comparison: Comparison | None = None) -> None:
    """Write ``suite.json``, ``.csv``, ``.md`` and ``.tex``, and ``index.html``.

    Raises:
        OSError: one cannot be written.
    """
    results.write(folder / "suite.json")
    write_csv(results, folder / "suite.csv")
    write_markdown(results, folder / "suite.md")
    write_latex(results, folder / "suite.tex")
    write_page(results, folder, comparison)
