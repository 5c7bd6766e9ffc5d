# SPDX-License-Identifier: Apache-2.0
"""tools/benchmark.py watched: what a page costs, and that somebody looked."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarking import watched
from benchmarking.options import BenchmarkError


def test_rates_are_compared_by_medians():
    rates = {
        watched.WITHOUT: [1.0, 2.0, 9.0],
        watched.ALONE: [1.8, 1.8, 1.8],
        watched.CLIENT: [1.9, 9.0, 0.1],
    }
    alone, client = watched.checks([{"run": how, "FPS": fps} for how, all_ in rates.items() for fps in all_])
    assert alone.value == pytest.approx(0.9) and not alone.met
    assert client.value == pytest.approx(0.95) and client.met


def test_a_client_is_sent_the_run(tmp_path: Path):
    pytest.importorskip("viser")
    options = watched.WatchedOptions(
        device="cpu", seq="office", frames="0:3", scale=0.1, rounds=1, data=tmp_path
    )
    [section] = watched.run(options).sections
    without, alone, client = section.rows
    assert [row["run"] for row in section.rows] == [watched.WITHOUT, watched.ALONE, watched.CLIENT]
    assert without["messages"] is None and alone["messages"] is None
    assert client["messages"] > 1 and client["MB"] > 0.01
    assert all(row["FPS"] > 0.0 and row["CPU s"] > 0.0 for row in section.rows)


def test_it_says_what_cannot_be_run(tmp_path: Path):
    with pytest.raises(BenchmarkError, match="rounds 0"):
        watched.run(watched.WatchedOptions(device="cpu", rounds=0))
    with pytest.raises(BenchmarkError, match="exit code 2"):
        watched.run(watched.WatchedOptions(device="cpu", seq=str(tmp_path / "absent"), rounds=1))
