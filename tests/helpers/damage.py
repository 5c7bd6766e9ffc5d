# SPDX-License-Identifier: Apache-2.0
"""Damage to recordings, by seed: what disks, transfers, editors and hostile people do to files."""

from __future__ import annotations

import os
import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path

_TEXT = {".json", ".txt", ".csv", ".pincam", ".traj", ".yaml"}
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WRONG = (
    b"nan",
    b"-inf",
    b"1e999",
    b"-1",
    b"0",
    b"1e30",
    b"9" * 5000,
    b"abc",
    b"",
    b'"7"',
    b"null",
    b"[1]",
    b"{}",
)


def damage(folder: Path, seed: int) -> list[str]:
    """Damage one to three files of a recording, and say how."""
    chance = random.Random(seed)
    done = []
    for _ in range(chance.choice((1, 1, 2, 3))):
        files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
        if not files:
            break
        # Small files are the ones that tell how to read the others.
        path = (
            chance.choice([f for f in files if f.suffix in _TEXT] or files)
            if chance.random() < 0.4
            else chance.choice(files)
        )
        kinds = [*_ANY, *(_IN_TEXT * 3 if path.suffix in _TEXT else _IN_BYTES * 3)]
        kind = chance.choice(kinds)
        kind(path, chance)
        done.append(f"{kind.__name__} {path.relative_to(folder)}")
    return done


def truncated(path: Path, chance: random.Random) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: chance.randrange(len(data) + 1)])


def bytes_flipped(path: Path, chance: random.Random) -> None:
    data = bytearray(path.read_bytes())
    reach = chance.choice((64, len(data)))  # a file's head tells what the rest is
    for _ in range(chance.randrange(1, 12)):
        if data:
            data[chance.randrange(min(reach, len(data)))] = chance.randrange(256)
    path.write_bytes(data)


def block_zeroed(path: Path, chance: random.Random) -> None:
    data = bytearray(path.read_bytes())
    at = chance.randrange(len(data) + 1)
    data[at : at + 512] = bytes(len(data[at : at + 512]))
    path.write_bytes(data)


def grown(path: Path, chance: random.Random) -> None:
    path.write_bytes(path.read_bytes() + chance.randbytes(chance.randrange(1, 5000)))


def emptied(path: Path, chance: random.Random) -> None:
    path.write_bytes(b"")


def gone(path: Path, chance: random.Random) -> None:
    path.unlink()


def renamed(path: Path, chance: random.Random) -> None:
    path.rename(path.with_name(chance.choice(("x", "-1", "1e9", "é", "0" * 40, "7 7")) + path.suffix))


def another_file(path: Path, chance: random.Random) -> None:
    others = sorted(other for other in path.parent.rglob("*") if other.is_file() and other != path)
    if others:
        shutil.copyfile(chance.choice(others), path)


def folder_instead(path: Path, chance: random.Random) -> None:
    path.unlink()
    path.mkdir()


def pipe_instead(path: Path, chance: random.Random) -> None:
    path.unlink()
    os.mkfifo(path)


def link_instead(path: Path, chance: random.Random) -> None:
    path.unlink()
    path.symlink_to(chance.choice(("/dev/zero", path.name, "/nowhere/at/all")))


def a_number_wrong(path: Path, chance: random.Random) -> None:
    data = path.read_bytes()
    found = list(_NUMBER.finditer(data))
    if found:
        at = chance.choice(found)
        path.write_bytes(data[: at.start()] + chance.choice(_WRONG) + data[at.end() :])


def a_line_gone_or_doubled(path: Path, chance: random.Random) -> None:
    lines = path.read_bytes().split(b"\n")
    at = chance.randrange(len(lines))
    lines[at : at + 1] = chance.choice(([], [lines[at]] * 2))
    path.write_bytes(b"\n".join(lines))


def not_text(path: Path, chance: random.Random) -> None:
    data = path.read_bytes()
    at = chance.randrange(len(data) + 1)
    path.write_bytes(
        data[:at] + chance.choice((b"\x00", b"\xff\xfe", b"\x1b[31m", b"../../../etc/")) + data[at:]
    )


def nested_without_end(path: Path, chance: random.Random) -> None:
    path.write_bytes(b"[" * 100_000)


Kind = Callable[[Path, random.Random], None]
_ANY: list[Kind] = [emptied, gone, renamed, another_file, folder_instead, pipe_instead, link_instead]
_IN_BYTES: list[Kind] = [truncated, bytes_flipped, block_zeroed, grown]
_IN_TEXT: list[Kind] = [
    truncated,
    a_number_wrong,
    a_number_wrong,
    a_line_gone_or_doubled,
    not_text,
    nested_without_end,
]
