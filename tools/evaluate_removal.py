# SPDX-License-Identifier: Apache-2.0
"""Take objects out of a run of the built-in office and compare with the office that never had them.

    python -m ggwarp.run --seq office --out runs/office1
    python tools/evaluate_removal.py runs/office1 stool globe "fruit bowl" --pictures pictures
    python tools/evaluate_removal.py runs/office1 --all --step 12

``--all`` means all but floor, ceiling and walls, and what carries others (:func:`removable`). A row an
object. ``hole``: PSNR (dB) over the pixels that the object covered, in every --step-th frame that shows it,
removed alone and filled; ``unseen``: those of them whose background no frame of the sequence shows.
``outside``: PSNR of all other pixels (a pixel away from the object), before and after, against the
office with and without the object. ``--light as-it-was`` compares with the office that keeps the object's
shade, and fills without taking it off.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.built_in.synthetic import FRAME_RATE, SyntheticOffice
from ggwarp.datasets.reader import resized
from ggwarp.editing.device import ready_device
from ggwarp.editing.edits import remove
from ggwarp.editing.inpaint.filling import FillConfig, fill_removed
from ggwarp.editing.inpaint.image_inpainting import inpaint_opencv, inpaint_shade
from ggwarp.editing.map_view import MapView
from ggwarp.editing.selection import select
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.io.trajectory import read_tum
from ggwarp.objects.inventory import ObjectRecord
from ggwarp.results.saved_run import RunError, SavedRun, load_run
from ggwarp.types import Float32, Float64, Frame

Bools = NDArray[np.bool_]

INPAINTERS = {"shade": inpaint_shade, "opencv": inpaint_opencv}
_LEAST = 30  # pixels that an object must cover in a frame to be compared there
_NEAR = 0.05  # metres between what carries and what is carried
_SHELL = ("floor", "ceiling", "wall")
_GOOD = 22.0  # dB
_TOLERANCE = 0.01  # metres and share of the depth, within which two depths are one surface


@dataclass(frozen=True)
class View:
    """A frame with an object, what it shows without it, and where they differ.

    Attributes:
        frame: with the object. empty: the same view without it.
        hole: [h, w] pixels that the object covers.
        unseen: [h, w] those whose background no frame shows.
    """

    frame: Frame
    empty: Frame
    hole: Bools
    unseen: Bools


@dataclass
class Error:
    """Squared colour errors, summed over pixels."""

    total: float = 0.0
    pixels: int = 0

    def add(self, image: Float32, reference: NDArray[np.uint8], where: Bools) -> None:
        """Count the pixels ``where`` [h, w] of ``image`` (0..1) against ``reference``."""
        difference = image[where].astype(np.float64) - reference[where] / 255.0
        self.total += float((difference**2).sum())
        self.pixels += int(where.sum())

    @property
    def psnr(self) -> float:
        """Over all pixels counted, dB; nan where there are none."""
        return -10.0 * float(np.log10(self.total / (3 * self.pixels))) if self.pixels else float("nan")


class Office:
    """The built-in office with and without an object, at a run's image size."""

    def __init__(self, indices: list[int], camera: Camera, *, shade_goes: bool = True) -> None:
        """Prepare the frames ``indices``; ``camera`` is the run's."""
        self._shade_goes = shade_goes
        self.camera = camera
        scale = min(1.0, 2.0 * camera.width / SyntheticOffice().camera.width)  # as a run reads its frames
        self._scale = scale
        office = SyntheticOffice(scale=scale)
        self.frames = [resized(office[i], camera) for i in indices]

    def views(self, object_id: int, step: int) -> list[View]:
        """Return every ``step``-th frame that shows ``object_id``, with the truth behind it."""
        office = SyntheticOffice(scale=self._scale, without=(object_id,), shade_goes=self._shade_goes)
        found = []
        for frame in self.frames[::step]:
            assert frame.mask is not None and frame.T_wc is not None
            hole = frame.mask == object_id
            if hole.sum() < _LEAST:
                continue
            empty = resized(office[frame.index], self.camera)
            assert empty.depth is not None
            rows, columns = np.nonzero(hole)
            unseen = np.zeros_like(hole)
            unseen[rows, columns] = self._never_seen(
                _points(empty.depth, self.camera, frame.T_wc, rows, columns), object_id
            )
            found.append(View(frame, empty, hole, unseen))
        return found

    def _never_seen(self, points: Float64, object_id: int) -> Bools:
        """Return [n] which of ``points`` [n, 3] no frame shows."""
        seen = np.zeros(len(points), bool)
        for frame in self.frames:
            assert frame.depth is not None and frame.mask is not None and frame.T_wc is not None
            local = se3.transform_points(se3.inverse(frame.T_wc), points)
            rows, columns, inside = self.camera.pixels_of(local)
            index = np.nonzero(inside)[0]
            at = (rows[index], columns[index])
            z = local[index, 2]
            agree = np.abs(frame.depth[at] - z) < _TOLERANCE * (1.0 + z)
            seen[index] |= agree & (frame.mask[at] != object_id)
        return ~seen


def _points(
    depth: Float32, camera: Camera, T_wc: Float64, rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> Float64:
    return se3.transform_points(T_wc, camera.back_project(columns, rows, depth[rows, columns]))


def removable(objects: Sequence[ObjectRecord]) -> list[ObjectRecord]:
    """Return the objects that can be taken out without another floating in the air.

    Floor, ceiling and walls stay, and what carries others: one's middle is over or in it, and its
    bottom higher.
    """

    def carries(one: ObjectRecord, other: ObjectRecord) -> bool:
        middle = 0.5 * (np.array(other.box.low) + np.array(other.box.high))
        over = all(one.box.low[k] < middle[k] < one.box.high[k] for k in (0, 1))
        low, high = one.box.low[2], one.box.high[2]
        return over and low + min(_NEAR, 0.5 * (high - low)) < other.box.low[2] < high + _NEAR

    movable = [o for o in objects if not o.name.endswith(_SHELL)]
    return [one for one in movable if not any(carries(one, o) for o in movable if o.id != one.id)]


def evaluate(
    run: SavedRun,
    office: Office,
    poses: dict[int, Float64],
    record: ObjectRecord,
    *,
    step: int = 3,
    inpainter: str = "shade",
    config: FillConfig = FillConfig(),  # noqa: B008 - frozen
    device: str = "cpu",
    pictures: Path | None = None,
) -> dict[str, float]:
    """Return the figures of ``record`` of ``run``; ``poses`` are its frames' by index."""
    chosen = select(run.gaussians, record.id)
    bare = remove(run.gaussians, chosen)
    filled, added = fill_removed(
        run.gaussians,
        chosen,
        run.camera,
        run.poses,
        inpaint=INPAINTERS[inpainter],
        config=config,
        device=device,
    )
    maps = {"before": run.gaussians, "removed": bare, "filled": filled}
    shown = {key: MapView(gaussians, run.camera, device=device) for key, gaussians in maps.items()}
    errors = {key: Error() for key in ("hole_removed", "hole", "unseen", "outside_before", "outside")}
    best: tuple[int, NDArray[np.uint8]] | None = None
    views = office.views(record.id, step)
    for view in views:
        images = {key: v.render(poses[view.frame.index]).rgb for key, v in shown.items()}
        outside = ~cv2.dilate(view.hole.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        errors["hole_removed"].add(images["removed"], view.empty.rgb, view.hole)
        errors["hole"].add(images["filled"], view.empty.rgb, view.hole)
        errors["unseen"].add(images["filled"], view.empty.rgb, view.unseen)
        errors["outside_before"].add(images["before"], view.frame.rgb, outside)
        errors["outside"].add(images["filled"], view.empty.rgb, outside)
        if best is None or view.hole.sum() > best[0]:
            strip = [np.rint(255.0 * image).astype(np.uint8) for image in images.values()]
            best = int(view.hole.sum()), np.hstack([*strip, view.empty.rgb])
    if pictures is not None and best is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(pictures / f"{record.id}.png"), best[1][..., ::-1])
    figures = {key: error.psnr for key, error in errors.items()}
    counts = {"views": len(views), "pixels": errors["hole"].pixels, "unseen_pixels": errors["unseen"].pixels}
    return {**counts, "added": added, **figures}


def summary(found: list[dict[str, float]]) -> str:
    """Return what the rows of :func:`evaluate` come to; objects that no frame shows do not count."""
    rows = [f for f in found if f["pixels"]]
    hole, bare = (np.array([f[key] for f in rows]) for key in ("hole", "hole_removed"))
    if not rows:
        return "no frame that is compared shows any of them"
    return (
        f"{len(rows)} objects: median {np.median(hole):.1f} dB (removed alone {np.median(bare):.1f}),"
        f" {int((hole >= _GOOD).sum())} at {_GOOD:g} dB or more ({int((bare >= _GOOD).sum())});"
        f" filling is worse in {int((hole < bare).sum())}"
    )


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("run", type=Path, help="run folder of the built-in office")
    parser.add_argument("objects", nargs="*", help="ids, or names that only one object has")
    parser.add_argument("--all", action="store_true", help="all that nothing else stands on")
    parser.add_argument("--step", type=int, default=3, help="compare every so-manyth frame")
    parser.add_argument("--inpaint", choices=INPAINTERS, default="shade")
    parser.add_argument(
        "--light", choices=("new", "as-it-was"), default="new", help="without or with the object's shade"
    )
    parser.add_argument("--pictures", type=Path, help="folder for before, removed, filled and true pictures")
    parser.add_argument("--device", help="auto, cpu or cuda:N")
    options = parser.parse_args(arguments)
    if bool(options.objects) == options.all:
        parser.error("name the objects, or give --all")
    try:
        run = load_run(options.run)
        device = ready_device(options.device)
        stamps, estimated = read_tum(options.run / "trajectory.txt")
        poses = {round(t * FRAME_RATE): T_wc for t, T_wc in zip(stamps.tolist(), estimated, strict=True)}
        shade_goes = options.light == "new"
        office = Office(sorted(poses), run.camera, shade_goes=shade_goes)
        print(
            f"{'object':18} {'views':>5} {'pixels':>7} {'unseen':>7} {'added':>6}"
            f" {'removed':>8} {'hole':>6} {'unseen':>7} {'outside':>8} {'change':>7}"
        )
        records = removable(run.objects) if options.all else [run.find(name) for name in options.objects]
        found = []
        for record in records:
            f = evaluate(
                run,
                office,
                poses,
                record,
                step=options.step,
                inpainter=options.inpaint,
                config=FillConfig(shade=shade_goes),
                device=device,
                pictures=options.pictures,
            )
            found.append(f)
            title = f"{record.id} {record.name}"
            print(
                f"{title:18} {f['views']:5} {f['pixels']:7} {f['unseen_pixels']:7} {f['added']:6}"
                f" {f['hole_removed']:8.2f} {f['hole']:6.2f} {f['unseen']:7.2f}"
                f" {f['outside_before']:8.2f} {f['outside'] - f['outside_before']:+7.3f}",
                flush=True,
            )
        print(summary(found))
    except RunError as error:
        print(f"evaluate_removal: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
