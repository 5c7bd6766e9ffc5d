# SPDX-License-Identifier: Apache-2.0
"""A stream of frames, of the room in ``recorded_scene``, as a sender writes it."""

import json

from recorded_scene import COLOUR, jpeg, look, millimetres, png, pose

HEAD = {"w": 80, "h": 60, "fx": COLOUR.fx, "fy": COLOUR.fy, "cx": COLOUR.cx, "cy": COLOUR.cy, "scale": 1000}


def sent(count: int = 3, **head: object) -> bytes:
    data = json.dumps(HEAD | head).encode() + b"\n"
    for i in range(count):
        rgb, depth = look(COLOUR, pose(i))
        parts = jpeg(rgb), png(millimetres(depth))
        line = {
            "timestamp": 5.0 + i,
            "color": len(parts[0]),
            "depth": len(parts[1]),
            "T_wc": pose(i).tolist(),
        }
        data += json.dumps(line).encode() + b"\n" + b"".join(parts)
    return data
