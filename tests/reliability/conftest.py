# SPDX-License-Identifier: Apache-2.0
"""A small recording, and the command in a process of its own."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from office_runs import contents_of, start_run

Started = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def start(tmp_path: Path) -> Started:
    """Start ``ggwarp run`` of the built-in office in ``tmp_path``, with further options."""
    return lambda *options, **words: start_run(tmp_path, *options, **words)


@pytest.fixture
def contents() -> Callable[[Path], dict[str, bytes]]:
    """Return a function that returns what is in a folder, file by file."""
    return contents_of
