# SPDX-License-Identifier: Apache-2.0
"""The command in a process of its own, over the built-in office, and what it leaves."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import ggwarp

OPTIONS = ("--preset", "fast", "--device", "cpu", "--scale", "0.1", "--save-renders", "2")


def start_run(folder: Path, *options: str, inside: str = "", **environment: str) -> subprocess.Popen[str]:
    """Start ``ggwarp run`` in ``folder``, with further options.

    Args:
        inside: a shell's words that run "$@" somewhere else.
        environment: variables that differ.
    """
    command = [sys.executable, "-m", "ggwarp", "run", "--seq", "office", *OPTIONS, *options]
    if inside:
        command = ["unshare", "--map-root-user", "--mount", "sh", "-c", inside, "sh", *command]
    paths = str(Path(ggwarp.__file__).parents[1])
    return subprocess.Popen(
        command,
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths, **environment},
    )


def contents_of(folder: Path) -> dict[str, bytes]:
    """Return what is in a folder, file by file; nothing where there is none."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}
