# SPDX-License-Identifier: Apache-2.0
"""Say what a sequence is taken for, and show a few of its frames; nothing is tracked or mapped.

ggwarp inspect my_recording
ggwarp inspect my_recording --masks my_masks --sheet sheet.png
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from ggwarp.datasets import DatasetError, open_dataset
from ggwarp.datasets.plan.sequence_plan import SequencePlan, plan_sequence
from ggwarp.io.atomic import atomic_write
from ggwarp.io.printable import printable

_SUFFIXES = (".png", ".jpg")


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code: 2 where the sequence cannot be used."""
    parser = argparse.ArgumentParser(prog="ggwarp inspect", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sequence", help="a sequence's name, folder or file")
    parser.add_argument("--data", type=Path, help="data root (default: $GGWARP_DATA, else ./data)")
    parser.add_argument("--masks", help="a folder of object masks, or none (default: those beside)")
    parser.add_argument(
        "--intrinsics", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"), help="the camera, in pixels"
    )
    parser.add_argument(
        "--sheet",
        type=Path,
        help="picture to write, or none (default: inspect-NAME.png)",
    )
    parser.add_argument("--json", action="store_true", help="print the plan as JSON")
    options = parser.parse_args(arguments)
    sheet: Path | None = options.sheet
    if sheet is not None and str(sheet) != "none" and sheet.suffix.lower() not in _SUFFIXES:
        parser.error(f"--sheet {sheet}: name a picture, {' or '.join(_SUFFIXES)}, or none")
    root = options.data or Path(os.environ.get("GGWARP_DATA") or "data")
    try:
        with _warnings() as heard:
            intrinsics = tuple(options.intrinsics) if options.intrinsics else None
            dataset = open_dataset(
                options.sequence, data_root=root, masks=options.masks, intrinsics=intrinsics
            )
            plan = plan_sequence(dataset, pictures=True)
        name = re.sub(r"[^\w.-]+", "_", dataset.name)
        written = _write_sheet(plan, sheet or Path(f"inspect-{name}.png"))
    except DatasetError as error:
        print(f"ggwarp: {printable(str(error))}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"ggwarp: {printable(f'{error.filename}: {error.strerror}')}", file=sys.stderr)
        return 1
    if options.json:
        print(json.dumps(plan.to_json() | {"messages": heard}, indent=1))
    else:
        for line in plan.lines():
            print(printable(line))
        if written is not None:
            print(printable(f"sheet:    {written}"))
    for line in (*heard, *plan.warnings):
        print(f"warning: {printable(line)}", file=sys.stderr)
    return 0


def _write_sheet(plan: SequencePlan, path: Path) -> Path | None:
    """Write the frames that were looked at; return where, None where there is nothing to show."""
    if str(path) == "none" or not plan.looked_at:
        return None
    import cv2

    from ggwarp.datasets.plan.contact_sheet import contact_sheet

    picture = cv2.cvtColor(contact_sheet(plan.looked_at), cv2.COLOR_RGB2BGR)
    with atomic_write(path) as file:
        file.write(cv2.imencode(path.suffix.lower(), picture)[1].tobytes())
    return path


@contextlib.contextmanager
def _warnings() -> Iterator[list[str]]:
    """Gather what the library warns of."""
    heard: list[str] = []

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            heard.append(record.getMessage())

    log, listener = logging.getLogger("ggwarp"), Listener(logging.WARNING)
    log.addHandler(listener)
    try:
        yield heard
    finally:
        log.removeHandler(listener)


if __name__ == "__main__":
    sys.exit(main())
