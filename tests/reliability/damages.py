# SPDX-License-Identifier: Apache-2.0
"""What happens to files: bytes that are cut, flipped, put in, left out, or of a stranger."""

from __future__ import annotations

import os
import pickle
import random
from collections.abc import Callable

Damage = Callable[[random.Random, bytes], bytes]

NASTY = (
    *(b"nan", b"-inf", b"1e400", b"9" * 400, b"-1", b"0", b"4294967296", b"1e-320", b"0x10", b"1_0"),
    *(b"[" * 3000, b"{}" * 9, b'"', b"\0", b"\xff\xfe", b"\x1b[31m", b"[/red]", b"\n" * 50, b"null", b"true"),
    *(
        b"../../../etc/passwd",
        b"/dev/zero",
        "\u202e\u0665".encode(),
        b"a." * 500 + b"b = 1\n",
        b"=",
        b"\\ud800",
    ),
)


class Canary:
    """Leaves a folder where it is unpickled."""

    place = ""

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, (Canary.place,)


def cut(rng: random.Random, data: bytes) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def flip(rng: random.Random, data: bytes) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice([1, 1, 3, 30])):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def overwrite(rng: random.Random, data: bytes) -> bytes:
    at, size = rng.randrange(len(data)), rng.choice([1, 4, 64, 512])
    filling = rng.choice([bytes(size), b"\xff" * size, rng.randbytes(size)])
    return data[:at] + filling + data[at + size :]


def insert(rng: random.Random, data: bytes) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice(NASTY) + data[at:]


def leave_out(rng: random.Random, data: bytes) -> bytes:
    at = rng.randrange(len(data))
    return data[:at] + data[at + rng.choice([1, 2, 16, 256]) :]


def repeat(rng: random.Random, data: bytes) -> bytes:
    at = rng.randrange(len(data))
    return data[:at] + data[at : at + 200] * rng.choice([2, 50]) + data[at:]


def replace_word(rng: random.Random, data: bytes) -> bytes:
    """Put something nasty in the place of a number or a word: what survives a parser's first look."""
    starts = [i for i in range(1, len(data)) if data[i : i + 1].isalnum() and not data[i - 1 : i].isalnum()]
    if not starts:
        return insert(rng, data)
    at = end = rng.choice(starts)
    while data[end : end + 1].isalnum() or data[end : end + 1] in (b".", b"-", b"_"):
        end += 1
    return data[:at] + rng.choice(NASTY) + data[end:]


def other(rng: random.Random, data: bytes) -> bytes:
    return rng.choice(
        [b"", rng.randbytes(300), pickle.dumps(Canary()), b"PK\x03\x04", b"ply\n", b"{}", b"[]"]
    )


DAMAGES: tuple[Damage, ...] = (
    cut,
    flip,
    overwrite,
    insert,
    leave_out,
    repeat,
    replace_word,
    replace_word,
    other,
)
