# SPDX-License-Identifier: Apache-2.0
"""Fetch a sequence from its official archive into the data root.

    ggwarp download replica office0
    ggwarp download tum fr1/xyz

A download that stops is resumed by the same command. An archive is checked while it is unpacked, and
nothing appears under the data root before it has passed.
"""

from __future__ import annotations

import argparse
import http.client
import os
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from ggwarp.commands.archives import DownloadError, NoRoomError, check_room, unpack
from ggwarp.datasets.readers.tum import full_name
from ggwarp.io.printable import printable

REPLICA_URL = "https://cvg-data.inf.ethz.ch/nice-slam/data/Replica.zip"
REPLICA_SCENES = ("room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4")
TUM_URL = "https://cvg.cit.tum.de/rgbd/dataset/freiburg{camera}/{name}.tgz"
_CHUNK = 1 << 20
_TIMEOUT = 30.0
_ATTEMPTS = 5
_PAUSE = 1.0


@dataclass(frozen=True)
class Source:
    """Where a sequence comes from and where it goes.

    Attributes:
        name: the sequence's name, as ``--seq`` takes it afterwards.
        url: its archive.
        folder: where the archive is unpacked.
        wanted: only archive paths that begin with one of these are unpacked; empty = all.
        sequence: the sequence's folder afterwards.
        licence: its terms, for the user.
    """

    name: str
    url: str
    folder: Path
    wanted: tuple[str, ...]
    sequence: Path
    licence: str


def find_source(kind: str, name: str, data: Path, url: str | None = None) -> Source:
    """Return where sequence ``name`` of ``kind`` ("replica" or "tum") comes from.

    Raises:
        DownloadError: there is no such sequence, or ``url`` is no web address.
    """
    if url is not None and not url.startswith(("http://", "https://")):
        raise DownloadError(f"{url}: is no http:// or https:// address")
    if kind == "replica":
        if name not in REPLICA_SCENES:
            raise DownloadError(f"{name}: no such Replica scene; there are {', '.join(REPLICA_SCENES)}")
        wanted = ("Replica/cam_params.json", f"Replica/{name}/")
        licence = (
            "Replica belongs to Meta: for non-commercial research only, see "
            "https://github.com/facebookresearch/Replica-Dataset/blob/main/LICENSE (rendered by NICE-SLAM; "
            "one archive of about 12 GB holds every scene)"
        )
        return Source(name, url or REPLICA_URL, data, wanted, data / "Replica" / name, licence)
    full = full_name(name)
    if full is None:
        raise DownloadError(
            f"{name}: no such TUM sequence; they are named like fr1/xyz or rgbd_dataset_freiburg1_xyz"
        )
    camera = full.removeprefix("rgbd_dataset_freiburg")[0]
    licence = "TUM RGB-D: CC BY 4.0, see https://cvg.cit.tum.de/data/datasets/rgbd-dataset"
    address = url or TUM_URL.format(camera=camera, name=full)
    return Source(full, address, data / "TUM", (), data / "TUM" / full, licence)


def fetch(source: Source, console: Console) -> Path:
    """Download, check and unpack ``source``; return the sequence's folder.

    An archive that holds more than the sequence is kept for the next one.

    Raises:
        DownloadError: the network, the archive or the disk fails; a part stays for the next try.
    """
    if source.sequence.is_dir():
        console.print(f"{source.sequence} is there already; remove it to fetch it again")
        return source.sequence
    console.print(source.licence)
    name = PurePosixPath(source.url.split("?")[0]).name
    archive = source.folder / (name if name.strip(".") else "archive")
    try:
        source.folder.mkdir(parents=True, exist_ok=True)
        if not archive.is_file():
            download(source.url, archive, console)
        console.print(f"checking and unpacking {archive}")
        try:
            unpack(archive, source.folder, wanted=source.wanted, needed=source.sequence)
        except NoRoomError:
            raise
        except DownloadError:
            archive.unlink()
            raise
        if source.wanted:
            console.print(f"{archive} is kept for its other sequences; remove it when you need the space")
        else:
            archive.unlink()
    except OSError as error:
        raise DownloadError(f"{error.filename or source.folder}: {error.strerror or error}") from error
    return source.sequence


def download(url: str, archive: Path, console: Console) -> None:
    """Download ``url`` to ``archive``, going on where an earlier try has stopped.

    Raises:
        DownloadError: the server refuses, or the connection keeps breaking.
    """
    part = archive.with_name(f".{archive.name}.part")
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), DownloadColumn())
    with Progress(*columns, TransferSpeedColumn(), TimeRemainingColumn(), console=console) as progress:
        task = progress.add_task(archive.name, total=None)
        failures, reason = 0, ""
        while failures < _ATTEMPTS:
            before = _size(part)
            try:
                with _connect(url, part) as (response, start, total):
                    check_room(archive.parent, 0 if total is None else total - start)
                    progress.update(task, total=total, completed=start)
                    with open(part, "r+b" if start else "wb") as file:
                        file.seek(start)
                        while chunk := response.read(_CHUNK):
                            check_room(archive.parent, len(chunk))
                            file.write(chunk)
                            progress.advance(task, len(chunk))
                if total is None or _size(part) == total:
                    os.replace(part, archive)
                    _validator(part).unlink(missing_ok=True)
                    return
                reason = f"the connection ended after {_size(part)} of {total} bytes"
            except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as error:
                reason = str(error.reason if type(error) is urllib.error.URLError else error)
            except ValueError as error:  # an address, or an answer, that nothing can be made of
                raise DownloadError(f"{url}: {error}; check the address") from None
            # Only tries that brought nothing count: a poor line may break often on 12 GB.
            failures = 0 if _size(part) > before else failures + 1
            time.sleep(_PAUSE * failures)
    raise DownloadError(f"{url}: {reason}; run the same command to go on, or name a mirror with --url")


@contextmanager
def _connect(url: str, part: Path) -> Iterator[tuple[http.client.HTTPResponse, int, int | None]]:
    """Open ``url`` where ``part`` ends; yields (response, first byte it sends, total size)."""
    have, validator = _size(part), _validator(part)
    request = urllib.request.Request(url, headers={"User-Agent": "ggwarp", "Accept-Encoding": "identity"})
    if have and validator.is_file():
        # If-Range: a file that has changed meanwhile is sent whole, not spliced.
        request.add_header("Range", f"bytes={have}-")
        request.add_header("If-Range", validator.read_text())
    try:
        response = urllib.request.urlopen(request, timeout=_TIMEOUT)
    except urllib.error.HTTPError as error:
        error.close()
        if error.code == 416:
            part.unlink()
            raise ConnectionError("the part on disk does not fit the file; starting over") from None
        if error.code < 500:
            raise DownloadError(
                f"{url}: HTTP {error.code} {error.reason}; check the name, or name a mirror with --url"
            ) from None
        raise
    with response:
        length = response.headers.get("Content-Length")
        total = int(length) if length and length.isascii() and length.isdigit() else None
        start = 0
        if response.status == 206:
            span = response.headers.get("Content-Range", "")
            if not span.startswith(f"bytes {have}-"):
                part.unlink()
                raise ConnectionError(f"the server sent {span or 'another range'}; starting over")
            start = have
            total = None if total is None else have + total
        mark = response.headers.get("ETag") or response.headers.get("Last-Modified")
        if mark and not mark.startswith("W/"):
            validator.write_text(mark)
        else:
            validator.unlink(missing_ok=True)
        yield response, start, total


def _validator(part: Path) -> Path:
    return part.with_name(f"{part.name}.version")


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code (2: it failed, and said why)."""
    parser = argparse.ArgumentParser(
        prog="ggwarp download", description="Fetch a sequence from its official archive."
    )
    parser.add_argument("kind", choices=("replica", "tum"))
    parser.add_argument("name", help="such as office0, fr1/xyz, freiburg3_long_office_household")
    parser.add_argument(
        "--data",
        type=Path,
        default=Path(os.environ.get("GGWARP_DATA", "data")),
        help="data root (default: $GGWARP_DATA, else ./data)",
    )
    parser.add_argument("--url", help="the archive on a mirror")
    options = parser.parse_args(arguments)
    # Paths are to be copied: neither wrapped nor taken for markup.
    console = Console(soft_wrap=True, markup=False, highlight=False)
    try:
        source = find_source(options.kind, options.name, options.data, options.url)
        sequence = fetch(source, console)
    except DownloadError as error:
        print(f"ggwarp download: {printable(str(error))}", file=sys.stderr)
        return 2
    except OSError as error:  # of the disk
        where = f"{error.filename}: " if error.filename else ""
        print(f"ggwarp download: {printable(f'{where}{error.strerror or error}')}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped; run the same command to go on", file=sys.stderr)
        return 130
    console.print(f"{sequence}: ggwarp run --data {options.data} --seq {source.name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
