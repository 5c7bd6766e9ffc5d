# SPDX-License-Identifier: Apache-2.0
"""``tracking``: registering a frame, beside small_gicp on the same points, and as the map grows."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarking.inputs.clouds import (
    RADIUS,
    Ours,
    Peer,
    Situation,
    grown,
    situation,
    small_gicp_or_none,
    tracking_sequence,
)
from benchmarking.machine import cores
from benchmarking.options import BenchmarkError, Common, cpu_threads, is_cpu, new_record, percent
from benchmarking.record import Check, Record, Row, Section
from benchmarking.timing import Timing, Work, measure
from ggwarp.config import device_name
from ggwarp.geometry import se3
from ggwarp.pipeline.tracking.gicp import GicpConfig, GicpTracker

BESIDE, GROWTH = "a frame beside small_gicp", "as the map grows"
_SIZES, _QUICK_SIZES = (1, 2, 5, 10), (1, 10)
_FLAT = 0.2  # how far a frame's time may move while the map grows tenfold
_BUDGET_S = 40.0
_BESIDE_NOTE = (
    "ellipses: covariances from the 10 nearest points, found round each one's pixel by us, in a tree by "
    "small_gicp; registration: from the previous pose, "
    f"matches within {RADIUS} m, to steps below 1e-5; frame: both. Tracker: our whole frame, depth image to "
    "pose with overlap, coarse to fine."
)
_ANSWER_NOTE = "same points, same covariances (small_gicp's), same start, same radius"


@dataclass(frozen=True)
class TrackingOptions(Common):
    """Registration of a frame: per frame and per linearisation, beside small_gicp; time against map size."""

    seq: str | None = None
    """Sequence; default: redkitchen under the data root, or else the built-in office at 640x363."""
    data: Path | None = None
    """Data root; default: $GGWARP_DATA, else ./data."""
    frames: int = 20
    """The last of so many frames is the one measured; those before it make the map."""
    rounds: int = 30
    """Interleaved repeats."""


def run(options: TrackingOptions) -> Record:
    """Measure and return the record.

    Raises:
        BenchmarkError: an option cannot be used.
        DatasetError: the sequence cannot.
    """
    if options.frames < 2:
        raise BenchmarkError(f"--frames {options.frames}: give 2 or more")
    record = new_record("tracking", options)
    device = device_name(options.device)
    root = options.data or Path(os.environ.get("GGWARP_DATA") or "data")
    dataset = tracking_sequence(options.seq, root)
    at = situation(dataset, options.frames, device=device)
    rounds = min(options.rounds, 5) if options.quick else options.rounds
    h, w = at.camera.height, at.camera.width
    inputs = {"sequence": dataset.name, "kind": dataset.kind, "image": f"{w}x{h}", "frame": at.frame.index}
    inputs |= {"points": at.seen.count, "map points": at.target.count}
    record.sections.append(Section("the frame", [inputs]))
    every = sorted({1, cores()}) if is_cpu(record) else [cores()]
    compared = [beside(record, at, threads, device, rounds) for threads in every]
    record.sections.append(Section(BESIDE, [row for rows, _ in compared for row in rows], _BESIDE_NOTE))
    answers = [row for _, row in compared if row is not None]
    if answers:
        record.sections.append(Section("the answer", answers, _ANSWER_NOTE))
    else:
        record.notes.append("small_gicp was not compared: pip install small_gicp")
    growth(record, at, _QUICK_SIZES if options.quick else _SIZES, device, rounds)
    return record


def beside(
    record: Record, at: Situation, threads: int, device: str, rounds: int
) -> tuple[list[Row], Row | None]:
    """Measure with one thread count; add the checks.

    Returns:
        Rows of times, ours and small_gicp's; how the answers compare (None without small_gicp).
    """
    with cpu_threads(threads):
        module = small_gicp_or_none()
        peer = None if module is None else Peer(at, module, threads)
        ours = Ours(at, device, None if peer is None else peer.covariances)
        works: dict[str, Any] = {
            "ellipses": ours.fit_ellipses,
            "map": lambda: ours.index_map(at.target),
            "registration": ours.register,
            "tracker": tracker_work(at, at.target, device),
        }
        if peer is not None:
            theirs = {"ellipses": peer.fit_ellipses, "map": peer.index_map, "registration": peer.register}
            works |= {f"peer {name}": work for name, work in theirs.items()}
        times = measure(works, device=device, rounds=rounds, budget_s=_BUDGET_S)
        rows = _rows(times, ours, peer, threads)
        if not is_cpu(record):
            frame_ms = 1e3 * _frame(times).median
            record.checks.append(Check("GICP a frame", frame_ms, "<=", 1.0, "ms", "target: H200"))
        return rows, None if peer is None else _compare(record, times, ours, peer, threads)


def _frame(times: dict[str, Timing], prefix: str = "") -> Timing:
    """Return ellipses and registration together."""
    pairs = zip(times[f"{prefix}ellipses"].samples, times[f"{prefix}registration"].samples, strict=True)
    return Timing(tuple(a + b for a, b in pairs))


def _rows(times: dict[str, Timing], ours: Ours, peer: Peer | None, threads: int) -> list[Row]:
    steps = ours.register().iterations
    peer_steps = None if peer is None else peer.register().iterations
    names = {"ellipses": "ellipses of the frame's points", "registration": "registration"}
    names |= {"map": "map, once a tracking keyframe", "tracker": "tracker"}
    rows: list[Row] = []

    def add(name: str, own: Timing, other: Timing | None, own_n: int = 1, other_n: int = 1) -> None:
        rows.append(
            {
                "what": name,
                "threads": threads,
                "ours ms": 1e3 * own.median / own_n,
                "spread %": percent(own.spread),
                "small_gicp ms": None if other is None else 1e3 * other.median / other_n,
                "its spread %": None if other is None else percent(other.spread),
                "ours / small_gicp": None if other is None else own.over(other) * other_n / own_n,
            }
        )

    for name, label in names.items():
        add(label, times[name], times.get(f"peer {name}"))
        if name == "registration":
            add("a linearisation", times[name], times.get("peer registration"), steps, peer_steps or 1)
            add("frame", _frame(times), None if peer is None else _frame(times, "peer "))
    return rows


def _compare(record: Record, times: dict[str, Timing], ours: Ours, peer: Peer, threads: int) -> Row:
    """Add the check on time; return how the poses differ."""
    own, other = ours.register(), peer.register()
    apart = se3.se3_log(se3.inverse(np.asarray(other.T_target_source)) @ own.T_wc)
    millimetres, milliradians = (1e3 * float(np.linalg.norm(part)) for part in (apart[:3], apart[3:]))
    record.checks.append(
        Check(
            f"GICP a frame / small_gicp's, {threads} thread{'s' * (threads > 1)}",
            _frame(times).over(_frame(times, "peer ")),
            "<=",
            1.0,
            "x",
            f"poses {millimetres:.3f} mm, {milliradians:.3f} mrad apart",
        )
    )
    return {
        "threads": threads,
        "apart mm": millimetres,
        "apart mrad": milliradians,
        "linearisations": own.iterations,
        "small_gicp's": other.iterations,
        "matches": own.matched,
        "small_gicp's matches": int(other.num_inliers),
    }


def tracker_work(at: Situation, target: Any, device: Any) -> Work:
    """Return a whole frame of tracking on ``target``, to be repeated from the same state."""
    tracker = GicpTracker(GicpConfig(), at.camera, device=device)
    return Work(
        run=lambda: tracker.track(at.frame, target),
        prepare=lambda: tracker.place(at.previous, target, at.T_previous),
    )


def growth(record: Record, at: Situation, sizes: tuple[int, ...], device: Any, rounds: int) -> None:
    """Add tracking time against the size of the map."""
    ours = Ours(at, device)
    maps = {times: grown(at.target, times, device=device) for times in sizes}
    works: dict[str, Any] = {}
    for times, target in maps.items():
        works[f"track {times}"] = tracker_work(at, target, device)
        works[f"index {times}"] = lambda target=target: ours.index_map(target)
    found = measure(works, device=device, rounds=rounds, budget_s=_BUDGET_S)
    first = found[f"track {sizes[0]}"]
    rows = [
        {
            "map": f"{times} x",
            "map points": maps[times].count,
            "frame ms": 1e3 * found[f"track {times}"].median,
            "spread %": percent(found[f"track {times}"].spread),
            "against the first": found[f"track {times}"].over(first),
            "map, once a keyframe, ms": 1e3 * found[f"index {times}"].median,
        }
        for times in sizes
    ]
    note = (
        "the map's points once more beside themselves, as dense as before; preparing the map, "
        "after each tracking keyframe, is not in the frame's time"
    )
    record.sections.append(Section(GROWTH, rows, note))
    change = max(abs(row["against the first"] - 1.0) for row in rows)
    record.checks.append(
        Check("tracking time, map ten times as large: change", percent(change), "<=", percent(_FLAT), "%")
    )
