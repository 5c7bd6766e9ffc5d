# SPDX-License-Identifier: Apache-2.0
"""The pictures of pages: what is said where one cannot be had."""

import subprocess
import sys
from pathlib import Path

import pytest

import docs_pages
from ggwarp.results.saved_run import RunError


def _saying(text: str) -> "subprocess.Popen[str]":
    return subprocess.Popen([sys.executable, "-c", f"print({text!r})"], stdout=subprocess.PIPE, text=True)


def test_the_address_is_read_from_what_a_run_says() -> None:
    url = "http://127.0.0.1:8081/?token=a-b_c"
    with _saying(f"sequence: office\n{url} (this machine alone)") as run:
        assert docs_pages._address(run) == url
    with _saying("sequence: office") as run, pytest.raises(RunError, match="no page"):
        docs_pages._address(run)


def test_without_a_browser_it_says_how_to_get_one(monkeypatch, capsys, tmp_path: Path) -> None:
    monkeypatch.setattr(docs_pages, "find_browser", lambda: None)
    with pytest.raises(SystemExit):
        docs_pages.main([str(tmp_path)])
    assert "apt-get install chromium" in capsys.readouterr().err


def test_a_folder_that_is_no_run_is_named(monkeypatch, capsys, tmp_path: Path) -> None:
    monkeypatch.setattr(docs_pages, "find_browser", lambda: "chromium")
    assert docs_pages.main([str(tmp_path / "absent")]) == 2
    assert "absent" in capsys.readouterr().err
