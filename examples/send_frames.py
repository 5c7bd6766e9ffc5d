# SPDX-License-Identifier: Apache-2.0
"""Send frames to ggwarp over a pipe, as a robot or a camera's driver would.

python examples/send_frames.py office 20 | ggwarp run --seq - --out runs/live
"""

import json
import os
import sys
from pathlib import Path

import cv2
import numpy as np

from ggwarp import open_dataset


def main(pipe, seq, frames=60, scale=0.5):
    dataset = open_dataset(seq, data_root=Path("data"))
    camera = dataset.camera.scaled(scale)
    size = (camera.width, camera.height)
    head = {"w": camera.width, "h": camera.height, "fx": camera.fx, "fy": camera.fy}
    head |= {"cx": camera.cx, "cy": camera.cy, "scale": 1000, "has_depth": dataset.has_depth}
    pipe.write(json.dumps(head).encode() + b"\n")
    for i in range(min(frames, len(dataset))):
        frame = dataset[i]
        rgb = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA)
        color, depth = cv2.imencode(".jpg", rgb[..., ::-1])[1].tobytes(), b""
        if frame.depth is not None:
            metres = cv2.resize(frame.depth, size, interpolation=cv2.INTER_NEAREST)
            depth = cv2.imencode(".png", np.rint(1000 * metres).astype(np.uint16))[1].tobytes()
        head = {"timestamp": frame.timestamp, "color": len(color), "depth": len(depth)}
        pipe.write(json.dumps(head).encode() + b"\n" + color + depth)
        pipe.flush()


if __name__ == "__main__":
    stdout = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print goes past the pipe
    main(stdout, sys.argv[1], int(sys.argv[2]))
