# SPDX-License-Identifier: Apache-2.0
"""``watched``: what the page costs a run: alone, and with a client that takes all and draws nothing."""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import threading
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarking.options import BenchmarkError, Common, new_record
from benchmarking.record import Check, Record, Row, Section
from benchmarking.runs import RunSpec
from ggwarp.config import device_name

COSTS = "what the page costs a run"
WITHOUT, ALONE, CLIENT = "no page", "page", "page and client"
_LEAST = {ALONE: 0.95, CLIENT: 0.9}
_ADDRESS = re.compile(r"http://\S+?token=[\w-]+")


@dataclass(frozen=True)
class WatchedOptions(Common):
    """The same run without the page, with it, and with a client, in turns."""

    seq: str = "office0"
    """The sequence."""
    preset: str = "gg-slam"
    """The preset."""
    frames: str = "0:60"
    """Slice of the sequence, A:B or A:B:STEP."""
    scale: float | None = None
    """Image scale; default: the command's."""
    rounds: int = 3
    """Turns."""
    data: Path | None = None
    """Data root; default: $GGWARP_DATA, else ./data."""


@dataclass
class Client:
    """What is sent to somebody who looks, taken in a thread and dropped.

    Attributes:
        messages, size: how many, bytes.
        ended: why no more came; "" while it goes on.
    """

    url: str
    messages: int = 0
    size: int = 0
    ended: str = ""
    _thread: threading.Thread | None = field(default=None, repr=False)

    def start(self) -> None:
        """Begin to look."""
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Wait for the page's end."""
        if self._thread is not None:
            self._thread.join(timeout=30.0)

    def _look(self) -> None:
        import msgspec
        import viser
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect
        from websockets.typing import Subprotocol

        camera = {
            "type": "ViewerCameraMessage",
            "wxyz": (1.0, 0.0, 0.0, 0.0),
            "position": (0.0, 0.0, 0.0),
            "fov": 1.0,
            "near": 0.01,
            "far": 100.0,
            "image_height": 800,
            "image_width": 1280,
            "look_at": (0.0, 0.0, 1.0),
            "up_direction": (0.0, -1.0, 0.0),
        }
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        address = self.url.replace("http", "ws", 1)
        try:
            with connect(address, subprotocols=[protocol], max_size=None) as page:
                page.send(msgspec.msgpack.encode(camera))  # whoever has no camera does not count as looking
                for message in page:
                    self.messages += 1
                    self.size += len(message)
            self.ended = "closed"
        except (OSError, WebSocketException) as error:
            self.ended = str(error)


def run(options: WatchedOptions) -> Record:
    """Run in turns and return the record.

    Raises:
        BenchmarkError: a run fails, or its page lets the client not in.
    """
    record = new_record("watched", options)
    frames, rounds = ("0:12", 1) if options.quick else (options.frames, options.rounds)
    if rounds < 1:
        raise BenchmarkError(f"--rounds {rounds}: give 1 or more")
    device = device_name(options.device)
    spec = RunSpec(
        options.seq, options.preset, frames=frames, scale=options.scale, data=options.data, device=device
    )
    rows = [_watched(spec, how) | {"round": k + 1} for k in range(rounds) for how in (WITHOUT, ALONE, CLIENT)]
    note = "FPS of tracking and mapping; CPU of the whole command, evaluation included; what was sent"
    record.sections.append(Section(COSTS, rows, note))
    record.checks += checks(rows)
    return record


def checks(rows: list[Row]) -> list[Check]:
    """Return the checks: a watched run's frame rate as a share of the unwatched one's, medians."""
    rates = {how: np.median([r["FPS"] for r in rows if r["run"] == how]) for how in (WITHOUT, *_LEAST)}
    return [
        Check(f"frame rate, {how} to {WITHOUT}", float(rates[how] / rates[WITHOUT]), ">=", least)
        for how, least in _LEAST.items()
    ]


def _watched(spec: RunSpec, how: str) -> Row:
    print(f"running {spec.label}, {how}", file=sys.stderr, flush=True)
    page = [] if how == WITHOUT else ["--viewer-at", "127.0.0.1:0"]
    client: Client | None = None
    before = _cpu_s()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "run"
        command = [sys.executable, "-m", "ggwarp.run", *spec.arguments(folder), *page]
        with subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | {"COLUMNS": "400"},
        ) as process:
            assert process.stdout is not None
            said: list[str] = []
            for line in process.stdout:
                said.append(line)
                if how == CLIENT and client is None and (found := _ADDRESS.search(line)):
                    client = Client(found[0])
                    client.start()
        if process.returncode:
            raise BenchmarkError(f"{spec.label}, {how}: exit code {process.returncode}: {said[-1].strip()}")
        metrics = json.loads((folder / "metrics.json").read_text())
    cpu_s = _cpu_s() - before
    if client is not None:
        client.join()
    if how == CLIENT and (client is None or client.messages == 0):
        raise BenchmarkError(
            f"{spec.label}: the page sent nothing: {client.ended if client else 'no address'}"
        )
    row: Row = {"run": how, "FPS": metrics["fps"], "CPU s": cpu_s}
    return row | {
        "messages": client.messages if client else None,
        "MB": client.size / 1e6 if client else None,
    }


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
