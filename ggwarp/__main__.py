# SPDX-License-Identifier: Apache-2.0
"""The front door: ``ggwarp COMMAND ...``, or ``python -m ggwarp COMMAND ...``."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence

from ggwarp import __version__
from ggwarp.interruption import Interruption, end_program_after

COMMANDS: dict[str, tuple[str, str]] = {
    "run": ("ggwarp.run", "follow a recording's camera, and learn a map of its room"),
    "view": ("ggwarp.viewer.__main__", "look at a run in the browser, and edit its objects there"),
    "objects": ("ggwarp.editing.__main__", "list, show, remove, move, paint and name a run's objects"),
    "report": ("ggwarp.report.__main__", "write a run's page anew, or one that compares several runs"),
    "export": (
        "ggwarp.export.__main__",
        "write a run's map or objects for other programs: splats, meshes, ...",
    ),
    "suite": ("ggwarp.suite.command", "run many recordings with many settings, and print papers' tables"),
    "inspect": ("ggwarp.commands.inspect_sequence", "say what a recording is taken for, and show its frames"),
    "doctor": ("ggwarp.commands.doctor", "say what this machine has, what is missing, and how to get it"),
    "download": ("ggwarp.commands.download", "fetch a sequence from its official archive"),
    "segment": ("ggwarp.commands.segment", "write object masks with an image segmenter"),
    "spoil-masks": ("ggwarp.commands.spoil_masks", "spoil object masks as trackers do, repeatably"),
    "compare-tracking": ("ggwarp.commands.compare_tracking", "compare tracking with small_gicp's"),
    "precompile": ("ggwarp.commands.precompile", "compile every kernel beforehand"),
}
"""Subcommand -> the module whose ``main(arguments)`` it is, imported when asked for, and what it does."""

FAILED = 1
USER_ERROR = 2

_LEVELS = {"-v": "DEBUG", "--verbose": "DEBUG", "-q": "WARNING", "--quiet": "WARNING"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the subcommand that ``arguments`` begin with, and return its exit code.

    A signal that would end the program ends the command instead: 130, 143, 129.
    """
    if arguments is None:
        end_program_after()
    # From the first moment on: what takes time to import comes after it.
    with Interruption() as interruption:
        try:
            return _main(list(sys.argv[1:] if arguments is None else arguments))
        except BaseException as error:
            if isinstance(error, SystemExit) or not (
                isinstance(error, KeyboardInterrupt) or interruption.requested
            ):
                raise
            print("ggwarp: interrupted", file=sys.stderr)
            return interruption.exit_code


def _main(rest: list[str]) -> int:
    loudness: list[str] = []
    while rest and rest[0] in _LEVELS:
        loudness.append(rest.pop(0))
    if not rest or rest[0] in ("-h", "--help"):
        print(_help())
        return 0 if rest else USER_ERROR
    if rest[0] == "--version":
        print(f"ggwarp {__version__}")
        return 0
    if rest[0].startswith("-"):
        rest.insert(0, "run")  # ggwarp --seq office0
    name, rest = rest[0], rest[1:]
    if name not in COMMANDS:
        import difflib

        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(COMMANDS)}"
        print(f"ggwarp: {name}: no such command; {hint}", file=sys.stderr)
        return USER_ERROR
    if name == "run":
        rest = loudness + rest
    elif loudness:
        import logging

        logging.getLogger("ggwarp").setLevel(_LEVELS[loudness[-1]])
    try:
        return importlib.import_module(COMMANDS[name][0]).main(rest)
    except ModuleNotFoundError as error:
        if (error.name or "ggwarp").partition(".")[0] == "ggwarp":
            raise
        print(f"ggwarp: {error.name} is not installed; ggwarp doctor says how to get it", file=sys.stderr)
        return USER_ERROR
    except BrokenPipeError:  # what was to read has gone: head, a pager
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED


def _help() -> str:
    rows = "\n".join(f"  {name:18}{about}" for name, (_, about) in COMMANDS.items())
    return f"""\
ggwarp {__version__}: object-level RGB-D Gaussian-splatting SLAM.

  ggwarp run --seq office                 a built-in room, on any machine
  ggwarp view runs/latest                 look at it, in the browser
  ggwarp objects runs/latest list         what is in it
  ggwarp doctor                           where something does not work

Commands (ggwarp COMMAND --help says more):
{rows}

Before or after run: -v says more, -q less. --version says which ggwarp this is."""


if __name__ == "__main__":
    sys.exit(main())
