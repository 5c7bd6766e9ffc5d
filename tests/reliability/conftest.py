# SPDX-License-Identifier: Apache-2.0
"""A small recording, and the command in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import ggwarp

Started = Callable[..., "subprocess.Popen[str]"]
OPTIONS = ("--preset", "fast", "--device", "cpu", "--scale", "0.1", "--save-renders", "2")


@pytest.fixture
def start(tmp_path: Path) -> Started:
    """Start ``ggwarp run`` of the built-in office in ``tmp_path``, with further options."""

    def started(*options: str, inside: str = "", **environment: str) -> subprocess.Popen[str]:
        """``inside``: a shell's words that run "$@" somewhere else."""
        command = [sys.executable, "-m", "ggwarp", "run", "--seq", "office", *OPTIONS, *options]
        if inside:
            command = ["unshare", "--map-root-user", "--mount", "sh", "-c", inside, "sh", *command]
        paths = str(Path(ggwarp.__file__).parents[1])
        return subprocess.Popen(
            command,
            cwd=tmp_path,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": paths, **environment},
        )

    return started


@pytest.fixture
def contents() -> Callable[[Path], dict[str, bytes]]:
    """Return a function that returns what is in a folder, file by file."""

    def read(folder: Path) -> dict[str, bytes]:
        files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        return {str(path.relative_to(folder)): path.read_bytes() for path in files}

    return read
