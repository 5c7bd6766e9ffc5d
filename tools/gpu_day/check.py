# SPDX-License-Identifier: Apache-2.0
"""The same small cases on two devices: ``save`` on the CPU beforehand, ``compare`` on the GPU.

    python -m gpu_day.check save REF.npz [--device cpu]
    python -m gpu_day.check compare REF.npz [--device cuda:0] [--only NAME ...]
    python -m gpu_day.check repeatable | two-threads

``tools`` must be on PYTHONPATH. Each case is tried by itself: a failure is printed with its traceback, and
the next one goes on. Exit code: how many cases failed or differ.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from benchmarking.inputs.walls import walls_cloud, walls_target
from ggwarp.runtime import loading
from ggwarp.runtime.streams import stream_scopes
from ggwarp.solvers.registration import Registrar
from gpu_day.cases import (
    CASES,
    DEFAULT_TOLERANCE,
    STAGES,
    TOLERANCES,
    Arrays,
    make_mapper,
    mapped,
)

_MOST_NUMBERS = 12_000  # of an array: the file travels


def save(file: Path, *, device: Any, only: Iterable[str] = ()) -> int:
    """Write the cases' results to ``file`` (.npz); return how many failed."""
    kept, failed = {}, 0
    for name in _chosen(only):
        found, seconds = _run(name, device)
        failed += found is None
        kept |= {f"{name}.{key}": value for key, value in (found or {}).items()}
        print(f"{name} {seconds:.1f} s", flush=True)
    np.savez_compressed(file, **kept)
    print(f"{file}: {file.stat().st_size / 2**20:.2f} MiB")
    return failed


def compare(file: Path, *, device: Any, only: Iterable[str] = ()) -> int:
    """Compare the cases' results with those in ``file``; return how many failed or differ."""
    reference = dict(np.load(file, allow_pickle=False))
    bad = 0
    for name in _chosen(only):
        found, seconds = _run(name, device)
        if found is None:
            bad += 1
            continue
        rows = [_difference(name, key, value, reference[f"{name}.{key}"]) for key, value in found.items()]
        good = all(fine for _, fine in rows)
        bad += not good
        print(f"{'ok  ' if good else 'DIFF'} {name} {seconds:.1f} s", flush=True)
        for line, fine in rows:
            if not fine or only:
                print("     ", "" if fine else "*", line, flush=True)
    return bad


def _chosen(only: Iterable[str]) -> list[str]:
    return [name for name in CASES if not only or name in only]


def _run(name: str, device: Any) -> tuple[Arrays | None, float]:
    """Run a case; return its arrays, thinned, or None if it failed, and the seconds it took."""
    started = time.perf_counter()
    try:
        found = CASES[name](device)
        wp.synchronize_device(device)
    except Exception as error:
        print(f"FAIL {name}: {type(error).__name__}: {error}", flush=True)
        traceback.print_exc()
        return None, time.perf_counter() - started
    return {key: _thinned(value) for key, value in found.items()}, time.perf_counter() - started


def _thinned(value: Any) -> Any:
    """Return every so-manyth number of a large array."""
    value = np.asarray(value)
    return value if value.size <= _MOST_NUMBERS else value.ravel()[:: value.size // 10_000]


def _difference(name: str, key: str, value: Any, reference: Any) -> tuple[str, bool]:
    """Return how an array differs from the reference, in words, and whether that is allowed."""
    if value.shape != reference.shape:
        return f"{key}: shape {value.shape}, not {reference.shape}", False
    v, r = value.astype(np.float64).ravel(), reference.astype(np.float64).ravel()
    if key == "objects":
        return f"{key}: {np.mean(v != r):.3%} of the pixels differ", bool(np.mean(v != r) < 0.1)
    finite = np.isfinite(r)
    if not (np.isfinite(v) == finite).all():
        return f"{key}: {np.count_nonzero(~np.isfinite(v))} numbers not finite", False
    error = float(np.linalg.norm(v[finite] - r[finite]) / max(float(np.linalg.norm(r[finite])), 1e-12))
    limits = TOLERANCES.get(name, {})
    return f"{key}: {error:.2e}", error <= limits.get(key, limits.get("*", DEFAULT_TOLERANCE))


def repeatable(device: Any) -> int:
    """Map recorded, recorded again, and launch by launch: 0 if all are the same to the bit."""
    runs = [mapped(device, recorded=recorded) for recorded in (True, True, False)]
    worst = [
        f"{label}: {key}"
        for label, run in (("again", runs[1]), ("direct", runs[2]))
        for key, value in runs[0].items()
        if not np.array_equal(value, run[key])
    ]
    print("repeatable:", "to the bit" if not worst else "NO: " + ", ".join(worst), flush=True)
    return int(bool(worst))


def two_threads(device: Any) -> int:
    """Run a mapper and a tracker's registrar on two streams, with recordings on both sides; 0 if both end."""
    rng = np.random.default_rng(7)
    target, cloud = walls_target(rng, 4000, device), walls_cloud(rng, 3000, np.eye(4), device)
    failures = []

    def track(scope: Any) -> None:
        registrar = Registrar(device=device)
        try:
            for _ in range(40):
                with scope:
                    registrar.register(cloud, target, np.eye(4), STAGES)
        except Exception:
            failures.append(traceback.format_exc())

    mapper = make_mapper(device)
    loading.load(loading.imported_kernel_modules(device), device)
    with stream_scopes(device) as (tracking, mapping):
        thread = threading.Thread(target=track, args=(tracking,), daemon=True)
        thread.start()
        for _ in range(60):
            with mapping:
                mapper.iterate()
        with mapping:
            print("two threads: loss", mapper.synchronise(), flush=True)
        thread.join(60.0)
    for text in failures:
        print("two threads: tracker:", text, flush=True)
    return int(bool(failures) or thread.is_alive())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m gpu_day.check", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("what", choices=["save", "compare", "repeatable", "two-threads"])
    parser.add_argument("file", nargs="?", type=Path, help="results of save (.npz)")
    parser.add_argument("--device", help="cpu for save, else cuda:0, unless told otherwise")
    parser.add_argument("--only", nargs="*", default=[], choices=list(CASES), help="these cases only")
    options = parser.parse_args(arguments)
    if options.what in ("save", "compare") and options.file is None:
        parser.error(f"{options.what}: name the file of results")
    loading.init_quietly()
    device = options.device or ("cpu" if options.what == "save" else "cuda:0")
    if options.what == "repeatable":
        return repeatable(device)
    if options.what == "two-threads":
        return two_threads(device)
    work = save if options.what == "save" else compare
    return work(options.file, device=device, only=options.only)


if __name__ == "__main__":
    sys.exit(main())
