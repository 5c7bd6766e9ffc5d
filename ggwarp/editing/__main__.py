# SPDX-License-Identifier: Apache-2.0
"""The command: ``ggwarp objects RUN VERB ...``."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence

from ggwarp.editing.command_line import EDITS, parse
from ggwarp.editing.progress import open_progress, part_of
from ggwarp.io.printable import printable
from ggwarp.results.saved_run import RunError, load_run, next_edit_folder, save_run

USER_ERROR = 2
INTERRUPTED = 130
_LONGEST_NAME = 60


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code: 0, 2 (the user's mistake) or 130 (Ctrl-C)."""
    try:
        steps = parse(list(sys.argv[1:] if arguments is None else arguments))
        return execute(steps)
    except RunError as error:
        return _refuse(str(error))
    except MemoryError:
        return _refuse("out of memory")
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _refuse(f"{where}{error.strerror or error}")
    except KeyboardInterrupt:
        return _refuse("interrupted", INTERRUPTED)


def execute(steps: list[argparse.Namespace]) -> int:
    """Do what ``steps`` (see :func:`ggwarp.editing.command_line.parse`) ask for; return the exit code."""
    first = steps[0]
    run = load_run(first.run)
    if run.gaussians.object_ids is None:
        raise RunError(f"{first.run}: its map knows no objects; run the sequence with masks")
    if first.verb == "list":
        from ggwarp.editing.pictures import print_table

        print_table(run)
        return 0
    if first.verb in EDITS:
        from ggwarp.editing import actions as apply

        # Refused before any work is done.
        out = first.out or next_edit_folder(run.folder)
        if out.exists():
            raise RunError(f"{out}: exists already, and nothing is overwritten; choose another --out")
        before = run
        with open_progress() as progress:
            for k, step in enumerate(steps):
                share = part_of(progress, k / len(steps), (k + 1) / len(steps))
                run = apply.apply(run, step, share)
        save_run(run, out)
        print(f"the edited map is in {printable(str(out))}")
        if first.picture and run.gaussians is not before.gaussians:
            from ggwarp.editing.pictures import write_before_and_after

            write_before_and_after(before, run, out, device=first.device)
        return 0
    from ggwarp.editing.pictures import write_extract, write_show

    record = run.find(first.id)
    folder = first.out or run.folder / "objects" / f"{record.id}-{_file_name(record.name)}"
    (write_show if first.verb == "show" else write_extract)(run, record, first, folder)
    return 0


def _file_name(text: str) -> str:
    return re.sub(r"[^\w.-]+", "_", text)[:_LONGEST_NAME]


def _refuse(message: str, code: int = USER_ERROR) -> int:
    print(f"ggwarp objects: {printable(message)}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
