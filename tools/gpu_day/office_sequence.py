# SPDX-License-Identifier: Apache-2.0
"""The built-in office rendered into a folder's files, so that a run on them needs no CPU kernel.

python -m gpu_day.office_sequence FRAMES SCALE DIR [DEVICE]
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from ggwarp.datasets import SyntheticOffice
from ggwarp.runtime import loading
from ggwarp.types import Frame

_DEPTH_SCALE = 6553.5


def write_office(frames: int, scale: float, folder: Path, *, device: str) -> None:
    """Render the first ``frames`` of the office's 120 on ``device`` and write them under ``folder``."""
    dataset = SyntheticOffice(frames=120, scale=scale, device=device)
    for name in ("color", "depth", "object_mask"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    c = dataset.camera
    camera = {"w": c.width, "h": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy}
    (folder / "camera.json").write_text(json.dumps(camera | {"scale": _DEPTH_SCALE}))
    with ThreadPoolExecutor(8) as pool:  # frames are rendered by this thread alone
        list(pool.map(lambda frame: _write(frame, folder), [dataset[i] for i in range(frames)]))
    rows = (" ".join(f"{v:.9g}" for v in dataset.trajectory[i].ravel()) for i in range(frames))
    (folder / "traj.txt").write_text("".join(f"{row}\n" for row in rows))


def _write(frame: Frame, folder: Path) -> None:
    assert frame.depth is not None and frame.mask is not None
    stem = f"{frame.index:06d}"
    fast = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    cv2.imwrite(str(folder / "color" / f"{stem}.jpg"), frame.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 97])
    depth = np.round(frame.depth * _DEPTH_SCALE).astype(np.uint16)
    cv2.imwrite(str(folder / "depth" / f"{stem}.png"), depth, fast)
    cv2.imwrite(str(folder / "object_mask" / f"{stem}.png"), frame.mask.astype(np.uint16), fast)


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    if len(arguments) not in (3, 4):
        print(__doc__, file=sys.stderr)
        return 2
    loading.init_quietly()
    frames, scale, folder, *device = arguments
    write_office(int(frames), float(scale), Path(folder), device=device[0] if device else "cuda:0")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
