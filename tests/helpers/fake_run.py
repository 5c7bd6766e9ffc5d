# SPDX-License-Identifier: Apache-2.0
"""Stands for ``ggwarp run``: leaves what a run leaves, in no time, and breaks as its sequence's name says."""

import json
import os
import shutil
import signal
import sys
import time
from pathlib import Path

from ggwarp.io.lock import lock_folder

FRAMES = 6
CHECKPOINT = "checkpoints/000001.safetensors"


def main(arguments: list[str]) -> int:
    options = dict(zip(arguments[::2], arguments[1::2], strict=True))
    out = Path(options["--out"])
    resumed = "--resume" in options
    state = out.with_name(f".{out.name}.partial-1")
    done = 0
    if resumed:
        checkpoint = CHECKPOINT if state.is_dir() else os.path.join(options["--resume"], CHECKPOINT)
        kept = json.loads((state / checkpoint).read_text())
        done, options = kept["done"], kept["options"] | options
    seq, seed = options["--seq"], int(options["--mapper.seed"])
    if seq == "refused":
        print("ggwarp: refused/: is no recording", file=sys.stderr)
        return 2
    state.mkdir(parents=True, exist_ok=True)
    lock_folder(state)  # until this process ends
    (state / "config.toml").touch()
    (state / "checkpoints").mkdir(exist_ok=True)
    for frame in range(done, FRAMES):
        kept = {"done": frame, "options": options}
        (state / CHECKPOINT).write_text(json.dumps(kept))
        if seq.startswith("killed") and not resumed and frame == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        if seq.startswith("waiting"):
            signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
            wait_for(out.parents[3] / "go")
    print(f"frames {done} to {FRAMES}")
    speed = float(options.get("--fps", 5.0))
    metrics = {"psnr": 30.0 + seed + len(seq) / speed, "fps": speed, "lpips": None, "failures": []}
    metrics |= {"heldout_psnr": metrics["psnr"] - 1.0, "frames_lost": 0, "frames": FRAMES}
    if seq == "broken":
        print("ggwarp: evaluation failed: out of luck", file=sys.stderr)
    (state / "metrics.json").write_text(json.dumps(metrics))
    shutil.rmtree(out, ignore_errors=True)
    state.rename(out)
    return 1 if seq == "broken" else 0


def wait_for(path: Path) -> None:
    for _ in range(3000):
        if path.exists():
            return
        time.sleep(0.01)
    raise TimeoutError(path)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
