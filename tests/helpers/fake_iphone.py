# SPDX-License-Identifier: Apache-2.0
"""A phone that streams the room in ``recorded_scene`` as the Record3D app does, to the app's own library.

It stands in for the computer's usbmuxd and for the app behind it: property lists that name the device and
connect to its port, then PeerTalk messages of a header, intrinsics, pose, JPEG, and LZFSE depth and
confidence. It is a process of its own, since the library waits for answers without letting Python run.
"""

from __future__ import annotations

import plistlib
import socket
import struct
import subprocess
import sys
import threading
from dataclasses import replace

import lzfse
import numpy as np

from recorded_scene import COLOUR, gl, jpeg, look, pose, quaternion

UDID = "00008101-000A1B2C3D4E001E"
LONGER = 1.1
"""Times the focal length, in frame 1 alone."""
_SMALL = (20, 15)
_PLIST = 8  # usbmuxd's number of a message that is a property list
_REFUSED = 3


class FakePhone:
    """A running phone; ``address`` is what USBMUXD_SOCKET_ADDRESS is to say. Use it as a context."""

    def __init__(self, *, devices: int = 1, listening: bool = True) -> None:
        """Start it: so many ``devices``, whose app answers or does not."""
        command = [sys.executable, __file__, str(devices), str(int(listening))]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self.address = self._process.stdout.readline().strip()

    def __enter__(self) -> FakePhone:
        return self

    def __exit__(self, *exception: object) -> None:
        self._process.kill()
        self._process.communicate()

    def send(self, i: int) -> None:
        """Send frame ``i`` of the room, as soon as the library is connected."""
        self._say(str(i))

    def stop(self) -> None:
        """End the stream."""
        self._say("stop")

    def _say(self, word: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{word}\n")
        self._process.stdin.flush()


def frame(i: int) -> bytes:
    """Return frame ``i`` as the app sends it."""
    focal = LONGER if i == 1 else 1.0
    camera = replace(COLOUR, fx=focal * COLOUR.fx, fy=focal * COLOUR.fy)
    sure = np.full(_SMALL[::-1], 2, np.uint8)
    sure[:2], sure[2:4] = 0, 1
    parts = (
        jpeg(look(camera, pose(i))[0]),
        lzfse.compress(look(camera.resized(*_SMALL), pose(i))[1].astype("<f4").tobytes()),
        lzfse.compress(sure.tobytes()),
        b"",
    )
    head = struct.pack("<11I", camera.width, camera.height, *_SMALL, *_SMALL, *map(len, parts), 1)
    K = struct.pack("<4f", camera.fx, camera.fy, camera.cx, camera.cy)
    T_wc = gl(pose(i))
    body = head + K + struct.pack("<7f", *quaternion(T_wc), *T_wc[:3, 3]) + b"".join(parts)
    return struct.pack(">4I", 1, 101, 0, len(body)) + body


def serve(server: socket.socket, devices: int, listening: bool) -> None:
    """Answer the library for ever."""
    while True:
        client = server.accept()[0]
        length, _, _, tag = struct.unpack("<4I", client.recv(16, socket.MSG_WAITALL))
        request = plistlib.loads(client.recv(length - 16, socket.MSG_WAITALL))
        if request["MessageType"] == "ListDevices":
            answer(client, tag, {"DeviceList": [device(k) for k in range(devices)]})
            client.close()
        elif request["MessageType"] == "Connect":
            answer(client, tag, {"MessageType": "Result", "Number": 0 if listening else _REFUSED})
            threading.Thread(target=stream, args=(client,), daemon=True).start()


def stream(client: socket.socket) -> None:
    """Send what standard input asks for."""
    for line in sys.stdin:
        if line.strip() == "stop":
            break
        client.sendall(frame(int(line)))
    client.close()


def answer(client: socket.socket, tag: int, values: dict) -> None:
    data = plistlib.dumps(values)
    client.sendall(struct.pack("<4I", 16 + len(data), 1, _PLIST, tag) + data)


def device(k: int) -> dict:
    properties = {"ConnectionType": "USB", "DeviceID": k + 1, "ProductID": 4776, "SerialNumber": UDID}
    return {"DeviceID": k + 1, "MessageType": "Attached", "Properties": properties}


if __name__ == "__main__":
    listener = socket.create_server(("127.0.0.1", 0))
    print(f"127.0.0.1:{listener.getsockname()[1]}", flush=True)
    serve(listener, int(sys.argv[1]), sys.argv[2] == "1")
