# SPDX-License-Identifier: Apache-2.0
"""A small sequence, and the command with a system that does nothing in its place."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from fake_slam import FRAMES, HEIGHT, WIDTH, FakeSlam
from ggwarp import preparation, session


@pytest.fixture
def scene(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Six frames in the Replica layout, with poses and masks."""
    folder = tmp_path / "data" / "Replica" / "room9"
    (folder / "results").mkdir(parents=True)
    (folder / "object_mask").mkdir()
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5, "scale": 1000}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    rows = []
    for i in range(FRAMES):
        rgb = rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
        cv2.imwrite(str(folder / f"results/frame{i:06d}.jpg"), rgb)
        cv2.imwrite(str(folder / f"results/depth{i:06d}.png"), np.full((HEIGHT, WIDTH), 2000, np.uint16))
        cv2.imwrite(str(folder / f"object_mask/frame{i:06d}.png"), np.full((HEIGHT, WIDTH), 4, np.uint8))
        T_wc = np.eye(4)
        T_wc[0, 3] = 0.1 * i
        rows.append(" ".join(map(str, T_wc.ravel())))
    (folder / "traj.txt").write_text("\n".join(rows) + "\n")
    return folder


@pytest.fixture
def fake(monkeypatch, tmp_path, tmp_path_factory):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("temporary")))
    monkeypatch.delenv("GGWARP_DATA", raising=False)
    monkeypatch.setattr(preparation, "Slam", FakeSlam)
    monkeypatch.setattr(session, "load_kernels", lambda device, display: None)
    return FakeSlam
