# SPDX-License-Identifier: Apache-2.0
"""Damage files in a thousand ways, hand them to whatever reads them, and report what came of it.

    python tests/reliability/fuzzing.py --count 1000 --seed 7

Prints JSON: how many files were taken and refused, what escaped, the most memory and CPU time. A reader may
take what it is given or refuse it in one line; anything else has escaped.
"""

from __future__ import annotations

import argparse
import contextlib
import gzip
import io
import json
import os
import random
import sys
import tarfile
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from damages import DAMAGES, Canary

from ggwarp.commands.archives import DownloadError, unpack
from ggwarp.config import ConfigError
from ggwarp.config.command_line import parse
from ggwarp.config.resumed_run import open_resumed
from ggwarp.editing.__main__ import main as objects
from ggwarp.geometry.camera import Camera
from ggwarp.io.camera import write_camera
from ggwarp.io.checkpoint import write_checkpoint
from ggwarp.io.guarded import FileError
from ggwarp.io.json import write_json
from ggwarp.io.ply import PlyError, read_ply, write_ply
from ggwarp.io.printable import printable
from ggwarp.io.toml import write_toml
from ggwarp.io.trajectory import write_tum
from ggwarp.map.gaussians import Gaussians
from ggwarp.objects.inventory import inventory
from ggwarp.objects.linear_classifier import LinearClassifier, write_classifier
from ggwarp.results.metrics import peak_memory_mb

Files = dict[str, bytes]
KINDS = ("run", "config", "ply", "archive", "checkpoint")


def small_run(folder: Path) -> Files:
    """A run folder of two objects, file by file."""
    rng = np.random.default_rng(0)
    ids = np.repeat(np.int32([0, 5, 8]), 6)
    n = len(ids)
    gaussians = Gaussians(
        rng.normal(size=(n, 3)).astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.full((n, 3), -3.0, np.float32),
        np.full(n, 3.0, np.float32),
        rng.normal(size=(n, 3)).astype(np.float32),
        ids,
        rng.normal(size=(n, 16)).astype(np.float32),
    )
    records = inventory(gaussians.means, gaussians.colours, ids, names={5: "cube", 8: "ball"})
    write_ply(folder / "map.ply", gaussians)
    write_json(folder / "objects.json", {"objects": [r.to_json() for r in records], "edits": [{"edit": "x"}]})
    write_camera(folder / "camera.json", Camera(96, 64, 80.0, 80.0, 47.5, 31.5))
    write_tum(folder / "trajectory.txt", np.arange(3), [np.eye(4)] * 3)
    write_classifier(
        folder / "classifier.npz",
        LinearClassifier(
            rng.normal(size=(3, 16)).astype(np.float32), np.zeros(3, np.float32), np.array([0, 5, 8])
        ),
    )
    write_toml(parse(["--seq", "office"]).run, folder / "config.toml")
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def with_pickle(name: str) -> bytes:
    """An archive of arrays, one of which is a pickle."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for key in ("weights", "biases", "ids"):
            array = io.BytesIO()
            np.lib.format.write_array(array, np.array([Canary()], object), allow_pickle=True)
            archive.writestr(f"{key}.npy", array.getvalue())
    return buffer.getvalue()


def archives() -> Files:
    content = bytes(range(256)) * 8
    zipped, tarred = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(zipped, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("seq/rgb/1.png", "seq/rgb.txt"):
            archive.writestr(name, content)
    with tarfile.open(fileobj=tarred, mode="w") as tar:
        for name in ("seq/rgb/1.png", "seq/" + "long" * 40 + ".txt"):
            member = tarfile.TarInfo(name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    return {
        "x.zip": zipped.getvalue(),
        "x.tgz": gzip.compress(tarred.getvalue(), mtime=0),
        "x.tar": tarred.getvalue(),
    }


class Campaign:
    """Readers, each given a damaged file; what they did is counted."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.rng = folder, random.Random(seed)
        self.outcomes: Counter[str] = Counter()
        self.escaped: list[str] = []
        self.slowest = 0.0
        base = folder / "base"
        base.mkdir()
        self.run = small_run(base)
        self.archives = archives()
        Canary.place = str(folder / "code was run")

    def case(self, number: int) -> None:
        kind = KINDS[number % len(KINDS)]
        folder = self.folder / f"{number}"
        folder.mkdir()
        began = time.process_time()
        said = io.StringIO()
        try:
            with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
                taken, line = getattr(self, kind + "_case")(folder)
        except BaseException as error:
            what = traceback.format_exception_only(error)[-1].strip()[:200]
            place = traceback.extract_tb(error.__traceback__)[-1]
            self.escaped.append(f"{kind} {number}: {what} ({place.filename}:{place.lineno})")
            return
        self.slowest = max(self.slowest, time.process_time() - began)
        if not line.isprintable() or len(line) > 600 or "Traceback" in said.getvalue():
            self.escaped.append(f"{kind} {number}: said {line[:200]!r}")
        self.outcomes[f"{kind} {'taken' if taken else 'refused'}"] += 1

    def damaged(self, data: bytes) -> bytes:
        for _ in range(self.rng.choice([1, 1, 1, 2, 4])):
            data = self.rng.choice(DAMAGES)(self.rng, data or b"\0")
        return data

    def run_case(self, folder: Path) -> tuple[bool, str]:
        name = self.rng.choice([n for n in self.run if n != "config.toml"])
        for other_name, data in self.run.items():
            (folder / other_name).write_bytes(data)
        path = folder / name
        special = self.rng.randrange(20)
        path.write_bytes(self.damaged(self.run[name]))
        if special < 4:
            path.unlink()
            make = (path.mkdir, lambda: os.mkfifo(path), lambda: path.symlink_to("/dev/zero"), lambda: None)
            make[special]()
        elif special == 4:
            (folder / "classifier.npz").write_bytes(with_pickle("weights"))
        said = io.StringIO()
        with contextlib.redirect_stderr(said):
            code = objects(
                [
                    str(folder),
                    *self.rng.choice([["list"], ["label", "5", "x"], ["recolor", "cube", "1", "2", "3"]]),
                ]
            )
        lines = said.getvalue().splitlines()
        if code not in (0, 2) or len(lines) != (code == 2):
            raise AssertionError(f"exit {code}: {lines[-3:]}")
        return code == 0, "".join(lines)

    def config_case(self, folder: Path) -> tuple[bool, str]:
        path = folder / "c.toml"
        path.write_bytes(self.damaged(self.run["config.toml"]))
        return self._tried(lambda: parse(["--config", str(path), "--seq", "office"]), ConfigError)

    def ply_case(self, folder: Path) -> tuple[bool, str]:
        path = folder / "map.ply"
        path.write_bytes(self.damaged(self.run["map.ply"]))
        return self._tried(lambda: read_ply(path), PlyError, FileError)

    def archive_case(self, folder: Path) -> tuple[bool, str]:
        name = self.rng.choice(sorted(self.archives))
        data = self.damaged(self.archives[name])
        if name == "x.tar":
            name, data = "x.tgz", gzip.compress(data, mtime=0)
        (folder / name).write_bytes(data)
        result = self._tried(
            lambda: unpack(folder / name, folder, wanted=("seq",), needed=folder / "seq"), DownloadError
        )
        left = {p.name for p in folder.iterdir()} - {name, "seq"}
        if left or (not result[0] and (folder / "seq").exists()):
            raise AssertionError(f"left behind: {left or 'half of it'}")
        return result

    def checkpoint_case(self, folder: Path) -> tuple[bool, str]:
        """Damage the file, or what it says: then its checksum is right."""
        record: dict[str, object] = {"frames": 2, "wall_s": 1.5, "refine_iterations": 0}
        tree: dict[str, Any] = {"target": "o", "linked": False, "earlier": None, "record": record}
        tree["config"] = self.run["config.toml"].decode()
        path = folder / "checkpoints/000001.safetensors"
        path.parent.mkdir()
        if self.rng.random() < 0.5:
            with contextlib.suppress(ValueError, RecursionError):
                tree["record"] = json.loads(self.damaged(json.dumps(record).encode()))
            write_checkpoint(path, tree)
        else:
            write_checkpoint(path, tree | {"poses": np.zeros((2, 4, 4))})
            path.write_bytes(self.damaged(path.read_bytes()))

        def read() -> None:
            run = open_resumed(folder)
            assert run.done >= 0 and run.refined >= 0 and run.wall_s >= 0.0

        return self._tried(read, ConfigError)

    def _tried(self, read: Callable[[], object], *refusals: type[Exception]) -> tuple[bool, str]:
        try:
            read()
        except refusals as error:
            return False, printable(str(error))  # as the commands say it
        return True, ""


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=7)
    options = parser.parse_args()
    warnings.simplefilter("error")  # a warning would be a second line
    with tempfile.TemporaryDirectory() as place:
        campaign = Campaign(Path(place), options.seed)
        for number in range(options.count):
            campaign.case(number)
        report = {
            "outcomes": dict(sorted(campaign.outcomes.items())),
            "escaped": campaign.escaped,
            "code_was_run": os.path.exists(Canary.place),
            "peak_mb": round(peak_memory_mb() or 0.0),
            "slowest_cpu_s": round(campaign.slowest, 3),
            "cpu_s": round(time.process_time(), 1),
        }
    print(json.dumps(report, indent=2))
    return 1 if report["escaped"] or report["code_was_run"] else 0


if __name__ == "__main__":
    sys.exit(main())
