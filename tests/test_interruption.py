# SPDX-License-Identifier: Apache-2.0
"""What a signal does: a request to stop, or an end at once where there is nothing to save."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import ggwarp
from ggwarp import interruption
from ggwarp.interruption import Interruption

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def send(number: int) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", SIGNALS, ids=lambda n: n.name)
def test_the_first_is_a_request_and_handlers_come_back(number: signal.Signals) -> None:
    before = [signal.getsignal(n) for n in SIGNALS]
    with Interruption() as asked:
        asked.at_once = False
        assert not asked.requested
        send(number)
        send(signal.SIGINT)  # pressed twice
        assert asked.requested and asked.number == number and asked.exit_code == 128 + number
        asked.forget()
        assert not asked.requested
    assert [signal.getsignal(n) for n in SIGNALS] == before


def test_where_there_is_nothing_to_save_it_ends_at_once() -> None:
    with Interruption() as asked, pytest.raises(KeyboardInterrupt):
        send(signal.SIGTERM)
    assert asked.exit_code == 143


def test_a_second_one_does_not_break_off_what_the_first_has_begun() -> None:
    with Interruption() as asked:
        try:
            send(signal.SIGTERM)
        except KeyboardInterrupt:
            send(signal.SIGINT)
            tidy = True
    assert tidy and asked.exit_code == 143


def test_a_later_one_ends_a_step_that_does_not_end_but_no_saving(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interruption, "_PATIENCE", -1.0)
    with Interruption() as asked:
        asked.at_once = False
        for number in SIGNALS:
            send(number)
        assert asked.number == signal.SIGINT
        with pytest.raises(KeyboardInterrupt), asked.breakable():
            send(signal.SIGINT)
        send(signal.SIGINT)


def test_nohup_is_meant() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interruption() as asked:
            send(signal.SIGHUP)
            assert not asked.requested
    finally:
        signal.signal(signal.SIGHUP, before)


_IN_EXEC = """
import os, signal, sys
from ggwarp.interruption import Interruption
with Interruption() as asked:
    try:
        exec("os.kill(os.getpid(), signal.SIGTERM)")
    except KeyboardInterrupt:
        sys.exit(asked.exit_code)
"""


def test_the_exit_code_is_the_signal_s_wherever_it_came(tmp_path: Path) -> None:
    (tmp_path / "asked.py").write_text(_IN_EXEC)
    environment = {**os.environ, "PYTHONPATH": str(Path(ggwarp.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-m", "asked"], cwd=tmp_path, env=environment)
    assert done.returncode == 143


def test_when_the_program_ends_a_second_one_changes_nothing(tmp_path: Path) -> None:
    code = (
        "import atexit, os, signal\natexit.register(os.kill, os.getpid(), signal.SIGTERM)\n"
        "from ggwarp.interruption import end_program_after\nend_program_after()\n" + _IN_EXEC
    )
    (tmp_path / "asked.py").write_text(code)
    environment = {**os.environ, "PYTHONPATH": str(Path(ggwarp.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-m", "asked"], cwd=tmp_path, env=environment)
    assert done.returncode == 143


_COMPILING = """
import atexit, os, threading, time
from ggwarp import interruption
from ggwarp.runtime import loading
interruption.end_program_after()
loading._PATIENCE = 0.1
loading._load_one = lambda module, device: time.sleep(60)
loading.uncompiled = lambda modules, device: []
threading.Timer(0.5, os.kill, (os.getpid(), 2)).start()
atexit.register(print, "the interpreter's own end")
try:
    loading.load([1, 2], "cpu")
except KeyboardInterrupt:
    print("interrupted")
    interruption.leave_compilers(130)
"""


def test_a_compiler_that_goes_on_is_left() -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(ggwarp.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", _COMPILING], env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "interrupted\n", "")


_AT_THE_DOOR = """
import importlib, os, sys
from ggwarp import __main__ as door
taken = importlib.import_module
importlib.import_module = lambda name: os.kill(os.getpid(), int(sys.argv[1])) or taken(name)
door.COMMANDS[sys.argv[1]] = ("ggwarp.editing.__main__", "")
sys.exit(door.main())
"""


@pytest.mark.parametrize("number", SIGNALS, ids=lambda n: n.name)
def test_before_any_command_is_imported(number: signal.Signals) -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(ggwarp.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, "-c", _AT_THE_DOOR, str(int(number))],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout, done.stderr) == (128 + number, "", "ggwarp: interrupted\n")


@pytest.mark.parametrize("number", SIGNALS, ids=lambda n: n.name)
def test_while_it_is_imported(tmp_path: Path, number: signal.Signals) -> None:
    """A library that takes long to import stands in for a slow disk."""
    (tmp_path / "warp.py").write_text("import time\nprint('importing', flush=True)\ntime.sleep(60)\n")
    paths = os.pathsep.join([str(tmp_path), str(Path(ggwarp.__file__).parents[1])])
    with subprocess.Popen(
        [sys.executable, "-m", "ggwarp", "run", "--seq", "office"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": paths},
    ) as command:
        assert command.stdout is not None and command.stdout.readline() == "importing\n"
        sent = time.monotonic()
        command.send_signal(number)
        _, errors = command.communicate(timeout=30)
    assert command.returncode == 128 + number and time.monotonic() - sent < 5.0
    assert errors == "ggwarp: interrupted; nothing was saved\n"
    assert [p.name for p in tmp_path.iterdir() if p.name != "__pycache__"] == ["warp.py"]
