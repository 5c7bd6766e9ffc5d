# SPDX-License-Identifier: Apache-2.0
"""Runs that are killed at random moments go on, with the bits of one that never was."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("kills.py")


def test_nothing_is_lost(campaign: bool, tmp_path: Path) -> None:
    if not campaign:
        pytest.skip("with --reliability; one kill is in tests/run/test_resume.py")
    done = subprocess.run(
        [sys.executable, str(SCRIPT), "--count", "200", "--seed", "1", "--folder", str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    report = json.loads(done.stdout)
    print(done.stdout)
    assert report["lost"] == [] and done.returncode == 0 and report["kills"] > 150
