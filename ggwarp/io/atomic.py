# SPDX-License-Identifier: Apache-2.0
"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def atomic_write(path: str | Path) -> Iterator[BinaryIO]:
    """Open ``path`` for writing bytes; it replaces what was there once the block has succeeded.

    The bytes are on the disk before the name is: a power cut leaves the old file or the new one, never half.

    Raises:
        OSError: the folder is missing, the disk is full, ...; it names ``path``, which is then as it was.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(part, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        if error.filename is None or os.fspath(error.filename) == str(part):
            error.filename = str(path)  # a full disk gives none
            error.filename2 = None
        raise
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
