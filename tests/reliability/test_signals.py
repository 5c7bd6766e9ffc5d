# SPDX-License-Identifier: Apache-2.0
"""SIGINT, SIGTERM and SIGHUP at random moments: a whole run each time, or none and a word about it."""

from __future__ import annotations

import contextlib
import json
import random
import shutil
import signal
import time
from collections import Counter
from pathlib import Path

import pytest

from ggwarp.results.run_folder import OUTPUTS
from ggwarp.results.saved_run import load_run

FRAMES = ("--frames", "0:5", "--refine", "30")
ALWAYS = set(OUTPUTS) - {"trajectory_gt.txt", "classifier.npz"}
NUMBERS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


@pytest.mark.parametrize("part", range(10))
def test_a_run_is_whole_whenever_it_is_stopped(
    campaign: bool, start, contents, tmp_path: Path, part: int
) -> None:
    """Every second trial gets a second signal, every twelfth has its kernels to compile, too."""
    if part and not campaign:
        pytest.skip("with --reliability")
    rng = random.Random(part)
    began = time.monotonic()
    with start(*FRAMES, "--out", "o") as whole:
        _, errors = whole.communicate()
    length = time.monotonic() - began
    assert whole.returncode == 0 and errors == ""
    shutil.copytree(tmp_path / "o", tmp_path / "earlier")
    earlier, ends, longest = contents(tmp_path / "o"), Counter(), 0.0
    for trial in range(6 if campaign else 1):
        number = NUMBERS[(trial + part) % 3]
        cold = {"WARP_CACHE_PATH": str(tmp_path / "kernels")} if trial == 4 and part % 2 else {}
        shutil.rmtree(tmp_path / "kernels", ignore_errors=True)
        shutil.rmtree(tmp_path / "o", ignore_errors=True)
        shutil.copytree(tmp_path / "earlier", tmp_path / "o")
        with start(*FRAMES, "--out", "o", **cold) as run:
            time.sleep(rng.uniform(0.0, 1.0) * length * (3.0 if cold else 1.0))
            sent = time.monotonic()
            with contextlib.suppress(ProcessLookupError):
                run.send_signal(number)
                if (trial + part) % 4 < 2:
                    time.sleep(rng.uniform(0.0, 0.5))
                    run.send_signal(signal.SIGTERM)
            out, errors = run.communicate(timeout=120)
        longest = max(longest, time.monotonic() - sent)
        where = f"trial {trial}, {number.name}: exit {run.returncode}\n{out[-300:]}\n{errors}"
        now = contents(tmp_path / "o")
        assert {p.name for p in tmp_path.iterdir()} <= {"o", "earlier", "kernels"}, where
        if out == "" and run.returncode in (-number, 1) and "ggwarp" not in errors:
            assert now == earlier, where  # Python itself had not begun with the program
            ends["before the program"] += 1
            continue
        assert "Traceback" not in errors, where
        if errors.splitlines()[-1:] in (["ggwarp: interrupted"], ["ggwarp: interrupted; nothing was saved"]):
            assert now == earlier and run.returncode == 128 + number, where
            ends["nothing to save"] += 1
            continue
        assert ALWAYS <= set(now) and now["map.ply"] != b"", where
        saved, metrics = load_run(tmp_path / "o"), json.loads(now["metrics.json"])
        assert len(saved.poses) == metrics["frames"] > 0 and metrics["failures"] == [], where
        # Ctrl-C in the refinement ends that alone; a signal may come when all is done.
        stopped = run.returncode in (128 + number, 128 + signal.SIGTERM)
        assert stopped or run.returncode in (0, -number, -signal.SIGTERM), where
        ends["stopped and saved" if stopped else "done"] += 1
    print(f"{dict(ends)}, the longest took {longest:.1f} s to end")
