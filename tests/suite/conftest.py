# SPDX-License-Identifier: Apache-2.0
"""A suite's site whose runs are tests/helpers/fake_run.py's."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import fake_run
from ggwarp.suite.attempts import Site
from ggwarp.suite.definition import Sequence, Setting, Suite
from ggwarp.suite.execution import open_site

SETTINGS = (Setting("slow", {"fps": 2.0}), Setting("quick", {"fps": 8.0}))


@pytest.fixture
def site(tmp_path: Path) -> Site:
    """A new suite's folder, and a data root that has every sequence."""
    return open_site(
        tmp_path / "suite", data=tmp_path / "data", command=(sys.executable, str(fake_run.__file__))
    )


@pytest.fixture
def suite_of(tmp_path: Path) -> Callable[..., Suite]:
    """Makes a suite of sequences by their names, which the data root then has."""

    def make(*seqs: str, **changes) -> Suite:
        for seq in seqs:
            (tmp_path / "data" / seq).mkdir(parents=True, exist_ok=True)
        values = {"settings": SETTINGS, "metrics": ("psnr", "lpips", "fps")} | changes
        return Suite("trial", tuple(Sequence(seq, seq) for seq in seqs), **values)

    return make
