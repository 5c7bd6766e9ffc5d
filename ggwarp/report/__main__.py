# SPDX-License-Identifier: Apache-2.0
"""Write a run's report.html anew, or one page that compares several runs.

ggwarp report runs/latest                       into the run's own folder
ggwarp report runs/a runs/b runs/c              compares them: comparison.html
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ggwarp.io.atomic import atomic_write
from ggwarp.io.printable import printable
from ggwarp.report.comparison import comparison
from ggwarp.report.page import FILE, report
from ggwarp.report.run_data import read_run
from ggwarp.results.saved_run import RunError

FAILED, USER_ERROR = 1, 2


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code: 1 where the page cannot be written, 2 for a user's mistake."""
    parser = argparse.ArgumentParser(
        prog="ggwarp report", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run folders, such as runs/latest")
    parser.add_argument(
        "--out", type=Path, help="the page to write (default: RUN/report.html, or comparison.html)"
    )
    args = parser.parse_args(arguments)
    try:
        runs = [read_run(folder) for folder in args.runs]
        page = report(runs[0]) if len(runs) == 1 else comparison(runs)
        path: Path = args.out or (args.runs[0] / FILE if len(runs) == 1 else Path("comparison.html"))
        with atomic_write(path) as file:
            file.write(page.encode())
    except RunError as error:
        print(f"ggwarp: {printable(str(error))}", file=sys.stderr)
        return USER_ERROR
    except OSError as error:
        print(f"ggwarp: {printable(f'{error.filename}: {error.strerror}')}", file=sys.stderr)
        return FAILED
    print(printable(str(path)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
