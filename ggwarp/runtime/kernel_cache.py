# SPDX-License-Identifier: Apache-2.0
"""Warp's folder of compiled kernels, kept sound.

Warp loads whatever lies in its cache: of a file that a full disk or a power cut has damaged, it fails to load
every time anew, or loads a kernel that does something else. So each binary gets a seal beside it, the hash of
what was compiled, and what does not match it is removed, to be compiled again. A binary without a seal (of
Warp alone) must look whole.

A cache has a folder a module, ``wp_NAME_HASH/``, with the binaries of several devices and one ``.meta`` file.
Other programs may be using it: what is removed is renamed first.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import hashlib
import json
import logging
import os
import shutil
import struct
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import warp as wp

_SEAL = ".sha256"
_BINARIES = (".o", ".cubin", ".ptx")
_ELF = b"\x7fELF\x02\x01"  # 64 bits, the lowest byte first: what Warp compiles to, wherever it runs
_NO_BITS = 8  # a section that takes no bytes of the file
_PROBE = 1 << 18
"""Bytes, more than any module takes that is compiled for a CPU, its source included."""
_FILES = 8
"""More files than a module has while it is compiled."""

_log = logging.getLogger(__name__)
_lock = threading.Lock()
_temporary = False


def folder_of(module: Any, block_dim: int | None = None) -> Path:
    """Return the folder of a Warp ``module`` in the cache."""
    return Path(str(wp.config.kernel_cache_dir)) / module.get_module_identifier(block_dim)


def binaries(folder: Path, ending: str | tuple[str, ...] = _BINARIES) -> list[Path]:
    """Return the compiled files in a module's ``folder``."""
    try:
        return sorted(path for path in folder.iterdir() if path.name.endswith(ending))
    except OSError:
        return []


def is_sound(binary: Path) -> bool:
    """Return whether ``binary`` and what Warp notes beside it are as they were compiled."""
    try:
        seal = _seal_of(binary)
        if seal.exists():
            return seal.read_text().strip() == _digest(binary)
        json.loads(_meta_of(binary).read_bytes())
        return _looks_whole(binary.read_bytes(), binary.suffix)
    except (OSError, ValueError):
        return False


def is_sealed(folder: Path) -> bool:
    """Return whether it is known what the binaries in ``folder`` should be."""
    return all(_seal_of(binary).exists() for binary in binaries(folder))


def seal(folder: Path) -> None:
    """Note what the binaries in ``folder`` are, where that is not noted yet and can be."""
    for binary in binaries(folder):
        path = _seal_of(binary)
        part = path.with_name(f"{path.name}.{os.getpid()}-{threading.get_ident()}")
        # A cache that cannot be written to, or has no room, works without.
        with contextlib.suppress(OSError):
            if path.exists():
                continue
            try:
                part.write_text(_digest(binary) + "\n")
                os.replace(part, path)
            finally:
                part.unlink(missing_ok=True)


def is_damaged(folder: Path) -> bool:
    """Return whether something in a module's ``folder`` is damaged."""
    return not all(map(is_sound, binaries(folder)))


def remove(folder: Path) -> None:
    """Remove a module's ``folder``, so that Warp compiles it again.

    Raises:
        OSError: it cannot be removed.
    """
    aside = folder.with_name(f"{folder.name}.damaged-{os.getpid()}-{threading.get_ident()}")
    with contextlib.suppress(FileNotFoundError):  # another program was faster
        os.rename(folder, aside)
        shutil.rmtree(aside, ignore_errors=True)


def clear_builds() -> None:
    """Remove what this thread began to compile and did not end: on a full disk it takes the room."""
    ending = f"_p{os.getpid()}_t{threading.get_ident()}"
    with contextlib.suppress(OSError):
        for path in Path(str(wp.config.kernel_cache_dir)).iterdir():
            if path.name.endswith(ending):
                shutil.rmtree(path, ignore_errors=True)


def why_not_writable(modules: int = 1) -> OSError | None:
    """Return what keeps the cache from taking so many more modules; None: nothing does.

    It must be asked beforehand: on a full disk the compiler ends the program.
    """
    folder = Path(str(wp.config.kernel_cache_dir))
    try:
        with tempfile.TemporaryDirectory(prefix="probe-", dir=folder) as inside:
            (Path(inside) / "probe").write_bytes(bytes(_PROBE * modules))
            status = os.statvfs(inside) if hasattr(os, "statvfs") else None
            if status is not None and 0 < status.f_files and status.f_favail < _FILES * modules:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError as error:
        return OSError(error.errno, error.strerror, str(folder))
    return None


def use_temporary(instead_of: str, reason: OSError) -> None:
    """Let this program compile into a temporary folder, which is removed when it ends; say so.

    Args:
        instead_of: the cache; nothing is done where another thread has left it already.

    Raises:
        OSError: there is no temporary folder; says what to do.
    """
    global _temporary
    with _lock:
        if str(wp.config.kernel_cache_dir or "") != instead_of:
            return
        if _temporary:
            raise no_room(reason)
        try:
            folder = tempfile.mkdtemp(prefix="ggwarp-kernels-")
        except OSError:
            raise no_room(reason) from None
        _temporary = True
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        wp.config.kernel_cache_dir = folder
    _log.warning(
        "the kernel cache %s cannot be written to (%s): kernels are compiled for this run only; "
        "WARP_CACHE_PATH names another folder",
        reason.filename or instead_of,
        reason.strerror,
    )


def is_temporary() -> bool:
    """Return whether the cache is one for this program only."""
    return _temporary


def no_room(reason: OSError) -> OSError:
    """Return ``reason`` as what a user is told who has no place for compiled kernels at all."""
    text = f"{reason.strerror}; kernels need some 5 MB: name a folder with room by WARP_CACHE_PATH"
    return OSError(reason.errno, text, reason.filename)


@contextlib.contextmanager
def held_stderr() -> Iterator[list[str]]:
    """Hold back what native code writes to standard error: afterwards it is in the list, line by line."""
    lines: list[str] = []
    with contextlib.ExitStack() as stack:
        try:
            held = stack.enter_context(_memory_file())
            kept = os.dup(2)
        except OSError:  # no place for it, or no standard error: let it through
            yield lines
            return
        os.dup2(held.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            held.seek(0)
            lines += held.read().decode(errors="replace").splitlines()


def _memory_file() -> Any:
    """Return a file that needs no disk, where the system has such."""
    if hasattr(os, "memfd_create"):
        return open(os.memfd_create("stderr"), "w+b")
    return tempfile.TemporaryFile()


def _seal_of(binary: Path) -> Path:
    return binary.with_name(binary.name + _SEAL)


def _meta_of(binary: Path) -> Path:
    return binary.with_name(binary.parent.name + ".meta")


def _digest(binary: Path) -> str:
    return hashlib.sha256(_meta_of(binary).read_bytes() + binary.read_bytes()).hexdigest()


def _looks_whole(data: bytes, ending: str) -> bool:
    """Return whether a compiled file has its end: of an ELF file, all sections lie inside it."""
    if not data.startswith(_ELF):
        other = ending == ".ptx" or (ending == ".o" and sys.platform != "linux")
        return other and data.rstrip(b"\0") == data != b""
    try:
        (start,) = struct.unpack_from("<Q", data, 40)
        size, count = struct.unpack_from("<HH", data, 58)
        if count < 2 or start + size * count > len(data):
            return False
        for i in range(1, count):  # the first stands for none
            kind, _, _, offset, length = struct.unpack_from("<IQQQQ", data, start + size * i + 4)
            if kind == 0 or (kind != _NO_BITS and offset + length > len(data)):
                return False
    except struct.error:
        return False
    return True
