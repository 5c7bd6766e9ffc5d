# SPDX-License-Identifier: Apache-2.0
"""Damaged run folders, configurations, maps and archives: taken, or refused in one line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("fuzzing.py")


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_nothing_escapes(campaign: bool, seed: int) -> None:
    if seed > 1 and not campaign:
        pytest.skip("with --reliability")
    count = 1000 if campaign else 200
    done = subprocess.run(
        [sys.executable, str(SCRIPT), "--count", str(count), "--seed", str(seed)],
        capture_output=True,
        text=True,
        check=False,
    )
    report = json.loads(done.stdout)
    print(done.stdout)
    assert report["escaped"] == [] and not report["code_was_run"] and done.returncode == 0
    assert sum(report["outcomes"].values()) == count and report["peak_mb"] < 1000
    kinds = [
        f"{kind} {outcome}"
        for kind in ("run", "config", "ply", "archive", "checkpoint")
        for outcome in ("taken", "refused")
    ]
    assert set(report["outcomes"]) == set(kinds), "each reader takes some and refuses some"
