# SPDX-License-Identifier: Apache-2.0
"""Make the pictures of README.md and docs/ that show a map: a run of the built-in office, edits, a film.

python tools/docs_images.py [--out docs/images] [--scale 0.42] [--frames 120] [--run FOLDER] [--real RUN]

Everything is as the map renders it, but for the last column of ``remove.jpg``, which is the scene without the
objects and their shade. ``growing.webp`` shows the map from above while it is built, roof and south wall
left out. ``real.jpg`` is the render and depth of a real recording's run: name one whose licence allows that.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ggwarp import FrameReader, Slam, SlamConfig, SyntheticOffice, load_run
from ggwarp.datasets.built_in.office import HEIGHT, WIDTH
from ggwarp.datasets.built_in.scene import looking
from ggwarp.editing.edits import extract, motion_about, move, recolour, remove
from ggwarp.editing.inpaint.filling import fill_removed
from ggwarp.editing.map_view import MapView
from ggwarp.editing.pictures import as_bytes, lit
from ggwarp.editing.selection import SelectionConfig, select
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.io.atomic import atomic_write
from ggwarp.map.gaussians import SH_C0, Gaussians, join
from ggwarp.report.colours import depth_in_colours, depth_limits, jpeg, object_colour, shrunk
from ggwarp.results.saved_run import RunError, SavedRun
from ggwarp.types import Float32, Float64, Frame
from ggwarp.viewer.colours import IDENTITY, splat_colours

Picture = NDArray[np.uint8]

_WIDTH = 1200
_GAP = 6
_QUALITY = 85
_PAINT = 0.65  # share of an object's colour over what is seen
_BOOKSHELF, _TABLE, _CABINET, _SOFA = 10, 96, 24, 104  # frames that show these well
_ABOVE = Camera(480, 340, 420.0, 420.0, 239.5, 169.5)
_EVERY, _FRAME_MS, _LAST_MS = 2, 200, 3000  # of the film: 120 frames are 15 seconds
_FILM_QUALITY = 60
_INSET = 150  # pixels, the current frame's width
_PATH = (255, 200, 40)


def side_by_side(rows: list[list[Picture]], width: int = _WIDTH) -> Picture:
    """Return pictures of one size as a table with white gaps, ``width`` pixels wide at most."""
    gap = np.full((rows[0][0].shape[0], _GAP, 3), 255, np.uint8)
    strips = [np.hstack([p for one in row for p in (gap, one)][1:]) for row in rows]
    line = np.full((_GAP, strips[0].shape[1], 3), 255, np.uint8)
    return shrunk(np.vstack([p for one in strips for p in (line, one)][1:]), width)


def modes(run: SavedRun, T_wc: Float64) -> list[Picture]:
    """Return colour, depth, objects and identities of the map from ``T_wc`` [4, 4]."""
    g = run.gaussians
    seen = MapView(g, run.camera).render(T_wc)
    depth = depth_in_colours(seen.surface_depth, depth_limits(seen.surface_depth))
    assert g.object_ids is not None
    known, rows = np.unique(g.object_ids, return_inverse=True)
    paint = np.array([object_colour(int(i)) for i in known], np.float32)[rows] / 255.0
    grey = np.clip(0.5 + SH_C0 * g.colours, 0.0, 1.0) @ np.array([0.299, 0.587, 0.114], np.float32)
    objects = _PAINT * paint + (1.0 - _PAINT) * grey[:, None]
    identities = splat_colours(g, IDENTITY, eye=T_wc[:3, 3])
    painted = [as_bytes(_painted(run, colours, T_wc)) for colours in (objects, identities)]
    return [as_bytes(seen.rgb), depth, *painted]


def _painted(run: SavedRun, colours: NDArray[np.floating], T_wc: Float64) -> Float32:
    coloured = replace(run.gaussians, colours=((colours - 0.5) / SH_C0).astype(np.float32))
    return MapView(coloured, run.camera).render(T_wc).rgb


def edited(run: SavedRun, T_wc: Float64) -> list[Picture]:
    """Return the map, the same with the plant lit, and with plant and stool moved and the sofa painted."""
    g, view = run.gaussians, MapView(run.gaussians, run.camera)
    before = view.render(T_wc).rgb
    plant = select(g, run.find("potted plant").id)
    after = recolour(g, select(g, run.find("sofa").id), (200, 40, 40))
    for name, shift in (("potted plant", (1.0, -0.35, 0.0)), ("stool", (-0.45, -0.25, 0.0))):
        record = run.find(name)
        chosen = select(after, record.id, SelectionConfig(cut_outliers=True))
        T = motion_about(record.centre, rotation=np.eye(3), translation=shift)
        moved = extract(move(after, chosen, T), chosen)
        left, _ = fill_removed(after, chosen | select(after, record.id), run.camera, run.poses)
        after = join(left, moved)
    shown = MapView(after, run.camera).render(T_wc).rgb
    return [as_bytes(before), as_bytes(lit(before, view.coverage(T_wc, plant)[0])), as_bytes(shown)]


def removed(run: SavedRun, names: tuple[str, ...], index: int, office: SyntheticOffice) -> list[Picture]:
    """Return the map, without the objects, with their holes filled, and the scene without them."""
    chosen = [select(run.gaussians, run.find(name).id) for name in names]
    bare = remove(run.gaussians, np.any(chosen, axis=0))
    filled, _ = fill_removed(run.gaussians, np.any(chosen, axis=0), run.camera, run.poses)
    maps = (run.gaussians, bare, filled)
    shown = [as_bytes(MapView(g, run.camera).render(run.poses[index]).rgb) for g in maps]
    ids = tuple(run.find(name).id for name in names)
    scale = run.camera.width / SyntheticOffice().camera.width
    truth = SyntheticOffice(frames=len(office), scale=scale, without=ids, shade_goes=True)[index].rgb
    size = (run.camera.width, run.camera.height)
    return [*shown, np.asarray(cv2.resize(truth, size, interpolation=cv2.INTER_AREA), np.uint8)]


def from_above(gaussians: Gaussians, path: list[Float64], frame: Picture) -> Picture:
    """Return the room from above and from the south, with the camera's way and what it sees now."""
    T_wc = np.eye(4)
    T_wc[:3, :3] = looking(np.pi / 2.0, np.radians(-50.0), 0.0)
    T_wc[:3, 3] = 0.0, -3.6, 5.0
    open_room = (gaussians.means[:, 2] < HEIGHT - 0.35) & (gaussians.means[:, 1] > -0.5 * WIDTH + 0.12)
    picture = as_bytes(MapView(gaussians.take(open_room), _ABOVE).render(T_wc).rgb)
    centres = np.array([T[:3, 3] for T in path])
    pixels, _ = _ABOVE.project(se3.transform_points(se3.inverse(T_wc), centres))
    line = np.rint(pixels).astype(np.int32)
    cv2.polylines(picture, [line], False, _PATH, 2, cv2.LINE_AA)
    cv2.circle(picture, tuple(line[-1].tolist()), 5, _PATH, -1, cv2.LINE_AA)
    inset = shrunk(frame, _INSET)
    height, width = inset.shape[:2]
    picture[-height - 2 :, : width + 2] = 255
    picture[-height:, :width] = inset
    return picture


def run_and_film(folder: Path, frames: int, scale: float) -> list[Picture]:
    """Run the office, save it as ``folder``, and return the film's pictures."""
    office = SyntheticOffice(frames=frames)
    film, path = [], []
    with FrameReader(office, range(frames), scale=scale) as reader:
        slam = Slam(SlamConfig(), reader.camera, reader.sensor_camera, device="cpu")
        for frame in reader:
            assert isinstance(frame, Frame)
            slam.step(frame)
            path.append(np.asarray(frame.T_wc))
            if frame.index % _EVERY == 0 or frame.index == frames - 1:
                film.append(from_above(slam.map_arrays(), path, frame.rgb))
                print(f"frame {frame.index + 1} of {frames}", flush=True)
    slam.save(folder, office.class_names)
    return film


def write_real(run: Path, path: Path) -> None:
    """Write the render and the depth of the middle frame of a run's ``pictures/`` side by side.

    Raises:
        RunError: it has none.
    """
    frames = sorted((run / "pictures").glob("frame*_frame.jpg"))
    if not frames:
        raise RunError(f"{run}: has no pictures; run the sequence again")
    middle = str(frames[len(frames) // 2])
    files = [middle.replace("_frame.jpg", f"_{kind}.jpg") for kind in ("render", "depth")]
    pictures = [np.asarray(Image.open(file).convert("RGB")) for file in files]
    with atomic_write(path) as file:
        file.write(jpeg(side_by_side([pictures]), _QUALITY))


def write_film(film: list[Picture], path: Path) -> None:
    """Write an animated WebP; its last picture stays a while."""
    first, *others = (Image.fromarray(picture) for picture in film)
    times = [_FRAME_MS] * len(others) + [_LAST_MS]
    options: dict[str, Any] = {"append_images": others, "duration": times, "quality": _FILM_QUALITY}
    with atomic_write(path) as file:
        first.save(file, "WEBP", save_all=True, loop=0, method=6, **options)


def write_pictures(run: SavedRun, out: Path, frames: int) -> None:
    """Write the pictures of a saved run of all ``frames``."""
    office, poses = SyntheticOffice(frames=frames), run.poses
    colour, depth, objects, identities = modes(run, poses[_BOOKSHELF])
    rows = [
        removed(run, ("fruit bowl", "stool"), _TABLE, office),
        removed(run, ("printer", "globe"), _CABINET, office),
    ]
    pictures = {
        "office": side_by_side([[colour, depth], [objects, identities]], 1006),
        "objects": side_by_side([[colour, objects, identities]]),
        "edit": side_by_side([edited(run, poses[_SOFA])]),
        "remove": side_by_side(rows),
    }
    for name, picture in pictures.items():
        with atomic_write(out / f"{name}.jpg") as file:
            file.write(jpeg(picture, _QUALITY))
        print(out / f"{name}.jpg")


def main(arguments: list[str] | None = None) -> int:
    """Make them all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("docs/images"), help="folder of the pictures")
    parser.add_argument("--run", type=Path, default=Path("runs/docs-images"), help="folder of the run")
    parser.add_argument("--scale", type=float, default=0.42, help="of 1200 x 680")
    parser.add_argument("--frames", type=int, default=120, help="of the whole walk")
    parser.add_argument("--real", type=Path, metavar="RUN", help="run folder of a real recording")
    options = parser.parse_args(arguments)
    if options.frames <= max(_BOOKSHELF, _TABLE, _CABINET, _SOFA):
        parser.error(f"--frames {options.frames}: the pictures need {1 + _SOFA} or more")
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        if options.run.exists():
            print(f"{options.run} is there: no film")
        else:
            write_film(run_and_film(options.run, options.frames, options.scale), options.out / "growing.webp")
        write_pictures(load_run(options.run), options.out, options.frames)
        if options.real is not None:
            write_real(options.real, options.out / "real.jpg")
    except RunError as error:
        print(f"docs_images: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
