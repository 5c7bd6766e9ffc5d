# SPDX-License-Identifier: Apache-2.0
"""The front door: it finds each command, and says what it does not know."""

from __future__ import annotations

import importlib
import subprocess
import sys
from types import SimpleNamespace

import pytest

import ggwarp
from ggwarp.__main__ import COMMANDS, main


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, list[str]]]:
    """The modules that the door opens, with their arguments; none of them does anything."""
    found: list[tuple[str, list[str]]] = []

    def opened(name: str) -> SimpleNamespace:
        return SimpleNamespace(main=lambda arguments: found.append((name, arguments)) or 7)

    monkeypatch.setattr(importlib, "import_module", opened)
    return found


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_says_how_it_is_used(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    assert stop.value.code == 0 and f"ggwarp {name}" in capsys.readouterr().out


def test_the_rest_is_the_command_s(asked) -> None:
    assert main(["spoil-masks", "office", "out", "--dots", "0.1"]) == 7
    assert asked == [("ggwarp.commands.spoil_masks", ["office", "out", "--dots", "0.1"])]


@pytest.mark.parametrize(
    ("arguments", "given"),
    [
        (["--seq", "office"], ["--seq", "office"]),
        (["-q", "run", "--seq", "office"], ["-q", "--seq", "office"]),
        (["-v", "--seq", "office"], ["-v", "--seq", "office"]),
    ],
)
def test_options_alone_are_a_run_s(asked, arguments: list[str], given: list[str]) -> None:
    assert main(arguments) == 7 and asked == [("ggwarp.run", given)]


@pytest.mark.parametrize(
    ("name", "says"),
    [("rnu", "did you mean run?"), ("object", "did you mean objects?"), ("xyz", "there are run,")],
)
def test_an_unknown_command_is_one_line(name: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"ggwarp: {name}: no such command") and says in line


def test_a_missing_package_is_one_line(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name}", name="tyro")

    monkeypatch.setattr(importlib, "import_module", missing)
    assert main(["run"]) == 2
    assert capsys.readouterr().err == "ggwarp: tyro is not installed; ggwarp doctor says how to get it\n"


def test_help_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0 and capsys.readouterr().out == f"ggwarp {ggwarp.__version__}\n"
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {name} " in shown for name in COMMANDS)
    assert main([]) == 2


def test_as_a_module(tmp_path) -> None:
    words = [sys.executable, "-m", "ggwarp"]
    done = subprocess.run([*words, "--version"], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0 and done.stdout == f"ggwarp {ggwarp.__version__}\n" and done.stderr == ""
