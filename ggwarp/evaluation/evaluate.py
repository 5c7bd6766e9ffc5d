# SPDX-License-Identifier: Apache-2.0
"""Compare the finished map with every frame of the run.

Two protocols from one pass: over all frames, as the papers do, and over held-out frames, those
never used for mapping. Frames are rendered at their estimated pose; a lost frame has a predicted
pose, is rendered there and counts like any other.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from typing import Literal

import numpy as np

from ggwarp.evaluation import image
from ggwarp.evaluation.lpips import Lpips
from ggwarp.evaluation.objects import ObjectFigures, ObjectRow, ObjectScore
from ggwarp.runtime.launch import cpu_threads
from ggwarp.types import Float32, Float64, Frame, Rendered

Reference = Literal["truth", "given"]

_MOST_THREADS = 4
"""Views wait to be scored in memory, some tens of MB each."""
_MEASURES = ("psnr", "psnr_exposed", "ssim", "lpips", "depth_l1_cm")


@dataclass(frozen=True)
class FrameScore:
    """One frame's view of the map against its picture; None = not measured.

    Attributes:
        index: the frame's index in the sequence.
        held_out: whether the frame was never used for mapping.
        psnr: dB.
        psnr_exposed: of the view in the picture's exposure, dB; see :func:`ggwarp.evaluation.image.matched`.
        ssim: see :mod:`ggwarp.evaluation.image`. lpips: see :mod:`ggwarp.evaluation.lpips`.
        depth_l1_cm: centimetres.
    """

    index: int
    held_out: bool
    psnr: float | None
    psnr_exposed: float | None
    ssim: float | None
    lpips: float | None
    depth_l1_cm: float | None


@dataclass(frozen=True)
class Scores(ObjectFigures):
    """One protocol's figures; None = not measured.

    Attributes:
        frames: how many frames they are over.
        psnr, psnr_exposed, ssim, lpips, depth_l1_cm: means of the frames' own.

    The objects' figures are accumulated over the frames' pixels.
    """

    frames: int = 0
    psnr: float | None = None
    psnr_exposed: float | None = None
    ssim: float | None = None
    lpips: float | None = None
    depth_l1_cm: float | None = None


@dataclass(frozen=True)
class Evaluation:
    """Both protocols and what they were computed from.

    Attributes:
        miou_against: what objects were compared with: the true masks, where the data set knows them
            for any frame, else those given to the mapper; None: nothing.
        objects: a row for every true object, over all frames.
    """

    all_frames: Scores = field(default_factory=Scores)
    held_out: Scores = field(default_factory=Scores)
    per_frame: list[FrameScore] = field(default_factory=list)
    miou_against: Reference | None = None
    objects: list[ObjectRow] = field(default_factory=list)


def evaluate(
    frames: Iterable[Frame],
    poses: dict[int, Float64],
    render: Callable[[Float64], Rendered],
    *,
    mapped: Iterable[int],
    watched: Iterable[int] = (),
    lpips: Lpips | None = None,
    on_view: Callable[[Frame, Rendered, FrameScore], None] | None = None,
) -> Evaluation:
    """Render every frame at its estimated pose and compare.

    Args:
        frames: at the image size that ``render`` gives.
        poses: index -> [4, 4] estimated camera-to-world pose; frames without one are passed over.
        render: the map's view from a camera-to-world pose.
        mapped: indices of frames ever used for mapping.
        watched: of others whose mask was used: objects are not held out in those, either.
        lpips: see :func:`ggwarp.evaluation.lpips.open_lpips`.
        on_view: called with each frame, its view and its score.
    """
    used = set(mapped)
    taught = used | set(watched)
    scores: list[FrameScore] = []
    objects: dict[tuple[Reference, bool], ObjectScore] = defaultdict(ObjectScore)
    for frame, view, score in _scored(frames, poses, render, used, lpips):
        scores.append(score)
        reference: Reference = "given" if frame.true_mask is None else "truth"
        given = frame.mask if frame.native_mask is None else frame.native_mask
        mask = given if frame.true_mask is None else frame.true_mask
        if mask is not None and view.objects is not None:
            objects[reference, frame.index not in taught].add(view.objects, mask)
        if on_view is not None:
            on_view(frame, view, score)
    # Frames whose truth is not known count only where that of no frame is.
    against: Reference = "truth" if any(r == "truth" for r, _ in objects) else "given"
    all_objects = objects[against, False] + objects[against, True]
    return Evaluation(
        all_frames=_summary(scores, all_objects),
        held_out=_summary([s for s in scores if s.held_out], objects[against, True]),
        per_frame=scores,
        miou_against=against if all_objects else None,
        objects=all_objects.table(),
    )


def _scored(
    frames: Iterable[Frame],
    poses: dict[int, Float64],
    render: Callable[[Float64], Rendered],
    used: set[int],
    lpips: Lpips | None,
) -> Iterator[tuple[Frame, Rendered, FrameScore]]:
    """Yield each frame that has a pose, its view and its score; some are scored while more are rendered."""
    threads = min(_MOST_THREADS, cpu_threads())
    waiting: deque[tuple[Frame, Rendered, Future[FrameScore]]] = deque()
    with ThreadPoolExecutor(threads, thread_name_prefix="ggwarp-score") as pool:
        for frame in frames:
            if frame.index not in poses:
                continue
            view = render(poses[frame.index])
            waiting.append((frame, view, pool.submit(_score, frame, view, frame.index not in used, lpips)))
            if len(waiting) > threads:
                done, seen, score = waiting.popleft()
                yield done, seen, score.result()
        for done, seen, score in waiting:
            yield done, seen, score.result()


def _score(frame: Frame, view: Rendered, held_out: bool, lpips: Lpips | None) -> FrameScore:
    reference: Float32 = np.divide(frame.rgb, 255.0, dtype=np.float32)
    valid = np.ones(frame.rgb.shape[:2], bool) if frame.depth is None else frame.depth > 0.0
    error = None if frame.depth is None else image.depth_l1(view.surface_depth, frame.depth)
    shown = valid[..., None]
    return FrameScore(
        index=frame.index,
        held_out=held_out,
        psnr=image.psnr(view.rgb, reference, valid),
        psnr_exposed=image.psnr(image.matched(view.rgb, reference, valid), reference, valid),
        ssim=image.ssim(view.rgb, reference, valid),
        lpips=lpips(view.rgb * shown, reference * shown) if lpips is not None and valid.any() else None,
        depth_l1_cm=None if error is None else 100.0 * error,
    )


def _summary(scores: list[FrameScore], objects: ObjectScore) -> Scores:
    means: dict[str, float | None] = {}
    for name in _MEASURES:
        values = [v for v in (getattr(s, name) for s in scores) if v is not None]
        means[name] = float(np.mean(values)) if values else None
    return Scores(frames=len(scores), **means, **asdict(objects.figures()))
