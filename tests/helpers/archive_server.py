# SPDX-License-Identifier: Apache-2.0
"""A server of archives on this machine, and the archives."""

import io
import tarfile
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

TUM = "rgbd_dataset_freiburg1_xyz"


class Server(ThreadingHTTPServer):
    """Serves one file; its attributes say how badly."""

    content = b""
    version = '"1"'
    knows_ranges = True
    status = 200
    length: str | None = None
    """What it says of the content's length; None: the truth."""
    break_after: list[int]
    """Bytes after which each coming answer breaks off; empty: no more do."""
    requests: list[tuple[str, str | None]]
    """(path, Range header) of what was asked."""

    def url(self, name: str) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/{name}"


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        wanted, server = self.headers.get("Range"), self.server
        server.requests.append((self.path, wanted))
        if server.status != 200:
            self.send_error(server.status)
            return
        body = server.content
        start = 0
        if wanted and server.knows_ranges and self.headers.get("If-Range") == server.version:
            start = int(wanted.removeprefix("bytes=").rstrip("-"))
            if start >= len(body):
                self.send_error(416)
                return
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{len(body) - 1}/{len(body)}")
        else:
            self.send_response(200)
        self.send_header("Content-Length", server.length or str(len(body) - start))
        self.send_header("ETag", server.version)
        self.end_headers()
        end = len(body)
        if server.break_after:
            end = min(end, start + server.break_after.pop(0))
        self.wfile.write(body[start:end])

    def log_message(self, format: str, *args: object) -> None:
        pass


def files_of(name: str) -> dict[str, bytes]:
    noise = np.random.default_rng(1).integers(0, 256, 50000).astype(np.uint8).tobytes()
    return {f"{name}/rgb.txt": b"1 rgb/1.png\n", f"{name}/depth.txt": b"", f"{name}/rgb/1.png": noise}


def make_tgz(files: dict[str, bytes], link: str | None = None) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        for name, data in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            tar.addfile(entry, io.BytesIO(data))
        if link:
            entry = tarfile.TarInfo(f"{TUM}/link")
            entry.type, entry.linkname = tarfile.SYMTYPE, link
            tar.addfile(entry)
    return buffer.getvalue()


def make_zip(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as zipped:
        for name, data in files.items():
            zipped.writestr(name, data)
    return buffer.getvalue()
