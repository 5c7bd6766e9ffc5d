# SPDX-License-Identifier: Apache-2.0
"""Send frames to a live run for as long as one likes, with everything that goes wrong with cameras and disks.

    python tests/reliability/soak.py --minutes 30 --seq redkitchen --data ../shared/data --fps 4

The sequence is walked to and fro. On the way the camera falls silent, sends a burst, half a picture, noise,
one of another size, none; it is covered, or carried away; its clock jumps; the program is halted (a laptop
asleep); and, where a disk may be mounted, that of the results is full for 45 seconds of every 165. The run
must end whole. Prints JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np

from ggwarp.datasets import FrameReader, open_dataset
from ggwarp.results.saved_run import load_run
from ggwarp.types import Frame

FAULTS = (
    *("silent", "burst", "cut", "noise", "size", "no depth", "no colour", "covered", "carried", "clock"),
    "halted",
)

Sent = tuple[dict[str, Any], bytes, bytes]

_MOUNTED = """
mount -t tmpfs -o size="$1" tmpfs "$2" || exit 99; disk=$2; kept=$3; shift 3
while sleep 120; do head -c 1G /dev/zero > "$disk/filler" 2>/dev/null; sleep 45; rm "$disk/filler"; done &
filler=$!
"$@"; code=$?
kill $filler; rm -f "$disk/filler"; cp -a "$disk" "$kept"; exit $code
"""


def encoded(frame: Frame) -> Sent:
    """Return a frame as it is sent: its line, its colour, its depth."""
    assert frame.depth is not None
    colour = cv2.imencode(".jpg", frame.rgb[..., ::-1])[1].tobytes()
    depth = cv2.imencode(".png", np.rint(1000.0 * frame.depth).astype(np.uint16))[1].tobytes()
    return {}, colour, depth


def empty_picture(width: int, height: int) -> Sent:
    black = np.zeros((height, width, 3), np.uint8)
    return (
        {},
        cv2.imencode(".jpg", black)[1].tobytes(),
        cv2.imencode(".png", black[..., 0].astype(np.uint16))[1].tobytes(),
    )


class Sender:
    """Sends frames, and lets things go wrong."""

    def __init__(
        self, file: BinaryIO, frames: list[Sent], size: tuple[int, int], fps: float, seed: int
    ) -> None:
        self.file, self.frames, self.size, self.fps = file, frames, size, fps
        self.rng = random.Random(seed)
        self.sent = 0
        self.faults: Counter[str] = Counter()
        self._place = self._clock = 0.0
        self._started = time.monotonic()

    def next_frame(self) -> Sent:
        n = len(self.frames) - 1
        self._place += 1
        return self.frames[round(abs((self._place % (2 * n)) - n))]

    def send(self, frame: Sent, wait: bool = True) -> None:
        line, colour, depth = frame
        self._clock += 1.0 / self.fps
        head = {"timestamp": self._clock, "color": len(colour), "depth": len(depth)} | line
        self.file.write(json.dumps(head).encode() + b"\n" + colour + depth)
        self.file.flush()
        self.sent += 1
        if wait:
            time.sleep(1.0 / self.fps)

    def fault(self, process: int) -> None:
        """Let one thing go wrong."""
        rng, good = self.rng, self.next_frame()
        kinds = [
            "silent",
            "burst",
            "cut",
            "noise",
            "size",
            "no depth",
            "no colour",
            "covered",
            "carried",
            "clock",
        ]
        kind = rng.choice([*kinds, "halted"])
        self.faults[kind] += 1
        if kind == "silent":
            time.sleep(8.0)
        elif kind == "burst":
            for _ in range(12):
                self.send(self.next_frame(), wait=False)
        elif kind == "cut":
            self.send((good[0], good[1][: len(good[1]) // 2], good[2]))
        elif kind == "noise":
            self.send((good[0], good[1], rng.randbytes(len(good[2]))))
        elif kind == "size":
            self.send(empty_picture(self.size[0] // 2, self.size[1] + 3))
        elif kind == "no depth":
            self.send((good[0], good[1], b""))
        elif kind == "no colour":
            self.send((good[0], b"", good[2]))
        elif kind == "covered":
            for _ in range(5):
                self.send(empty_picture(*self.size))
        elif kind == "carried":
            self._place += len(self.frames) // 3
        elif kind == "clock":
            self.send(({"timestamp": rng.choice([float("nan"), -1e300, 0.0, "x", None])}, *good[1:]))
        else:
            os.kill(process, signal.SIGSTOP)
            time.sleep(6.0)
            os.kill(process, signal.SIGCONT)


def resident_mb(process: int) -> float:
    line = next(s for s in Path(f"/proc/{process}/status").read_text().splitlines() if s.startswith("VmRSS"))
    return int(line.split()[1]) * 1024 / 1e6


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seq", default="office")
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--scale", type=float, default=0.2)
    parser.add_argument("--fps", type=float, default=4.0)
    parser.add_argument("--every", type=float, default=20.0, help="seconds between faults, in the mean")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    dataset = open_dataset(options.seq, data_root=options.data)
    with FrameReader(dataset, range(len(dataset)), scale=options.scale) as reader:
        camera = reader.camera
        frames = [encoded(frame) for frame in reader if isinstance(frame, Frame)]
    with tempfile.TemporaryDirectory() as place:
        disk, kept = Path(place) / "disk", Path(place) / "kept"
        disk.mkdir()
        command = [sys.executable, "-m", "ggwarp", "run", "--seq", "-", "--scale", "1", "--preset", "fast"]
        command += ["--fps", f"{options.fps:g}", "--save-renders", "100", "--memory", "0.02"]
        command += ["--checkpoint-every", "30s", "--out", str(disk / "run")]
        may = subprocess.run(["unshare", "--map-root-user", "--mount", "true"], capture_output=True)
        if may.returncode == 0:
            inside = ["unshare", "--map-root-user", "--mount", "sh", "-c", _MOUNTED, "sh"]
            command = [*inside, "64m", str(disk), str(kept), *command]
        with open(Path(place) / "said", "w+") as said:
            run = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=said, stderr=said)
            assert run.stdin is not None
            head = {"w": camera.width, "h": camera.height, "fx": camera.fx, "fy": camera.fy}
            run.stdin.write(
                json.dumps(head | {"cx": camera.cx, "cy": camera.cy, "scale": 1000}).encode() + b"\n"
            )
            sender = Sender(run.stdin, frames, (camera.width, camera.height), options.fps, options.seed)
            memory: list[float] = []
            until, pid = time.monotonic() + 60.0 * options.minutes, 0
            while time.monotonic() < until and run.poll() is None:
                for _ in range(max(1, round(sender.rng.expovariate(1.0 / (options.every * options.fps))))):
                    sender.send(sender.next_frame())
                pid = pid or _program_of(run.pid)
                memory.append(resident_mb(pid))
                sender.fault(pid)
            run.stdin.close()
            code = run.wait()
            said.seek(0)
            lines = said.read().splitlines()
        folder = (kept if kept.exists() else disk) / "run"
        whole = load_run(folder)
        metrics = json.loads((folder / "metrics.json").read_text())
    wanted = ("frames", "frames_skipped", "frames_lost", "frames_late", "late_ms_max", "gaussians", "psnr")
    report = {
        "minutes": round((time.monotonic() - sender._started) / 60.0, 1),
        "sent": sender.sent,
        "faults": dict(sorted(sender.faults.items())),
        "code": code,
        "poses": len(whole.poses),
        "failures": metrics["failures"],
        **{name: metrics[name] for name in wanted},
        "resident_mb": [round(value) for value in memory[:: max(1, len(memory) // 10)]],
        "not saved on the way": sum("not saved so far" in line for line in lines),
        "tracebacks": sum("Traceback" in line for line in lines),
        "last words": lines[-1],
    }
    print(json.dumps(report, indent=2))
    return int(code != 0 or report["tracebacks"] > 0 or report["poses"] != metrics["frames"])


def _program_of(process: int) -> int:
    """Return the process of the run: this one, or a child of it that Python is."""
    for child in Path(f"/proc/{process}/task/{process}/children").read_text().split():
        if Path(f"/proc/{child}/cmdline").read_bytes().startswith(os.fsencode(sys.executable)):
            return int(child)
    return process


if __name__ == "__main__":
    sys.exit(main())
