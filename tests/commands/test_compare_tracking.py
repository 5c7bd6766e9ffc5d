# SPDX-License-Identifier: Apache-2.0
"""ggwarp compare-tracking without what it compares with."""

import pytest

from ggwarp.commands import compare_tracking


def test_without_the_peer_it_says_what_to_install(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(compare_tracking, "small_gicp", None)
    assert compare_tracking.main(["office0"]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.endswith("small_gicp is not installed: pip install small_gicp")


def test_an_unknown_sequence_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("small_gicp")
    assert compare_tracking.main(["nothing"]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("ggwarp compare-tracking: nothing: no such sequence")
