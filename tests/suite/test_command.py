# SPDX-License-Identifier: Apache-2.0
"""ggwarp suite, as it is typed: exit codes, what it says, what it leaves."""

import functools
import json
import sys
from pathlib import Path

import pytest

import fake_run
from ggwarp.config import load_config
from ggwarp.suite import command
from ggwarp.suite.execution import open_site

FILE = """
seeds = [0, 1]
metrics = ["psnr", "fps"]
sequences = ["room0", "absent"]

[settings]
slow = { fps = 2.0 }
quick = { fps = 8.0 }

[resources]
memory_gb = 0.01
"""


@pytest.fixture
def typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Runs ``ggwarp suite mine.toml ...`` in a folder that has it, with a data root of one sequence."""
    monkeypatch.chdir(tmp_path)
    stand_in = (sys.executable, str(fake_run.__file__))
    monkeypatch.setattr(command, "open_site", functools.partial(open_site, command=stand_in))
    Path("mine.toml").write_text(FILE)
    Path("data/room0").mkdir(parents=True)
    return lambda *words: command.main(["mine.toml", *words])


def only_line(capsys: pytest.CaptureFixture[str]) -> str:
    [line] = capsys.readouterr().err.splitlines()
    return line


def test_a_suite_leaves_its_tables(typed, capsys):
    assert typed() == command.DONE
    said = capsys.readouterr()
    assert "mine: 8 runs" in said.out and "4 done, 4 not run; tables in suites/mine/index.html" in said.out
    assert "absent, slow, seed 0: not run: absent is not under" in said.err
    left = {path.name for path in Path("suites/mine").iterdir()}
    assert left == {".suite", "runs", "suite.json", "suite.csv", "suite.md", "suite.tex", "index.html"}
    runs = json.loads(Path("suites/mine/suite.json").read_text())["runs"]
    done = [run for run in runs if run["status"] == "done"]
    assert len(done) == 4 and str(Path.cwd()) not in json.dumps(done), "nothing of this machine's paths"
    assert typed() == command.DONE and "4 done before" in capsys.readouterr().out


def test_a_failed_run_is_the_exit_code(typed, capsys):
    Path("data/broken").mkdir()
    assert typed("--seq", "room0", "broken") == command.FAILED
    assert "4 done, 4 failed" in capsys.readouterr().out
    assert typed("--seq", "absent", "--out", "other") == command.FAILED, "nothing was done"


def test_what_would_be_run_is_listed(typed, capsys):
    assert typed("--list") == command.DONE
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 8 and lines[0] == "room0/slow/seed-0: not run"
    typed()
    capsys.readouterr()
    typed("--list")
    assert capsys.readouterr().out.splitlines()[0] == "room0/slow/seed-0: done"


def test_an_earlier_suite_is_compared(typed, capsys):
    typed("--seq", "room0", "--out", "old")
    assert typed("--seq", "room0", "--out", "new", "--compare", "old") == command.DONE
    said = capsys.readouterr().out
    assert "slow: PSNR 33.000 -> 33.000 (p 1, pairs 2): the same" in said and "too few" in said
    assert "Against old" in Path("new/index.html").read_text()


def test_the_fastest_that_is_good_enough_becomes_a_configuration(typed, capsys):
    """The stand-in's PSNR is 31.1 and 33.0 dB at 8 and 2 frames a second."""
    assert typed("--seq", "room0", "--within", "2") == command.DONE
    assert (
        "chosen: quick: 30.12 dB at 8.00 fps; the best, slow: 32.00 dB at 2.00 fps" in capsys.readouterr().out
    )
    assert load_config(Path("suites/mine/chosen.toml")).fps == 8.0
    assert typed("--seq", "room0", "--within", "1") == command.DONE
    assert load_config(Path("suites/mine/chosen.toml")).fps == 2.0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--out", "data"], "--out data: holds other files and no suite; name a new folder"),
        (["--ray", "auto", "--device", "cuda:1"], "--device cuda:1: Ray hands out GPUs; leave it at auto"),
        (["--jobs", "0"], "--jobs 0: give 1 or more"),
        (["--within", "-1"], "within -1 dB: give a number of dB, 0 or more"),
        (["--compare", "nowhere"], "nowhere: cannot be read"),
        (["--seq", "-"], "-: live frames come once; name a recording"),
        (["--seq", "a/b", "a_b"], "a/b and a_b would share a folder; rename one of them"),
    ],
)
def test_mistakes_are_one_line(typed, capsys, words: list[str], says: str):
    assert typed(*words) == command.USER_ERROR
    line = only_line(capsys)
    assert line.startswith("ggwarp suite: ") and says in line


def test_without_ray_a_cluster_is_one_line(typed, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert typed("--ray", "auto") == command.USER_ERROR
    assert only_line(capsys).endswith("Ray is not installed; pip install 'ggwarp[cluster]'")


def test_a_signal_ends_it_and_says_that_it_goes_on(typed, capsys, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "execute", interrupted)
    assert typed() == 130
    assert only_line(capsys) == "ggwarp suite: stopped; the same command goes on"
