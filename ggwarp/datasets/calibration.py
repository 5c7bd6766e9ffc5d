# SPDX-License-Identifier: Apache-2.0
"""Camera files: ``cam_params.json``, ``camera.json``, ``calibration.txt`` and their relatives."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ggwarp.datasets.base import DatasetError
from ggwarp.datasets.formats.camera_file import JSON_EXAMPLE, camera_values, in_full, lens_notes
from ggwarp.datasets.poses import rigid
from ggwarp.datasets.rig import Lens, Rig
from ggwarp.datasets.text import numbers_of
from ggwarp.geometry.camera import Camera
from ggwarp.io.camera import camera_fault, finite_number, size_fault
from ggwarp.io.printable import printable, shown
from ggwarp.types import Float64

CAMERA_FILES = (
    "camera.json",
    "cam_params.json",
    "camera_intrinsic.json",
    "intrinsic.json",
    "intrinsics.json",
    "calibration.txt",
    "intrinsics.txt",
)
"""Names of the camera files of one's own recordings, in the order they are tried."""

Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy in pixels, of images at their native size."""

_LEAST_SCALE, _LARGEST_SCALE = 1.0, 1e6
"""Of 16-bit depth: nothing is measured in units of more than a metre, or finer than a micrometre."""
_LARGEST_COEFFICIENT = 1e4
"""Of a lens's distortion; rational models come with coefficients of a few hundred."""

_LIKE_A_CAMERA = re.compile(r"(?i)cam|calib|intrin|param|^k\.")
_SHORTEST_FOCAL = 4.0
"""Pixels; intrinsics in shares of the image are below it."""


@dataclass(frozen=True)
class Calibration:
    """How a recording's images are to be read.

    Attributes:
        camera: the pinhole camera, at native size.
        depth_scale: raw depth / depth_scale = metres.
        distortion: the colour lens's OpenCV coefficients (k1 k2 p1 p2 [k3 ...]); empty = none.
        depth: the depth pictures' own lens; None: they show what the colour camera does, at any size.
        T_colour_depth: [4, 4] takes points of the depth camera to the colour camera; None: the same place.
        depth_distorted: whether depth without a lens of its own is bent as the colour is; None: nobody says.
        origin: the file or option that gives the camera, for messages.
        scale_origin: who says what depth_scale is; empty: nobody, it is assumed.
        notes: what is odd about the file, a line each.
    """

    camera: Camera
    depth_scale: float
    distortion: tuple[float, ...] = ()
    depth: Lens | None = None
    T_colour_depth: Float64 | None = None
    depth_distorted: bool | None = None
    origin: str = ""
    scale_origin: str = ""
    notes: tuple[str, ...] = ()

    def rig(self) -> Rig:
        """Return what makes frames of the pictures.

        Raises:
            DatasetError: the distortion leaves nothing of the picture.
        """
        return Rig(
            Lens(self.camera, self.distortion),
            depth=self.depth,
            T_colour_depth=self.T_colour_depth,
            depth_distorted=bool(self.depth_distorted),
        )

    @property
    def depth_unit(self) -> str:
        """The depth's unit, and how it is bent, in words."""
        unit = self.unit_in_words
        if not self.distortion or self.depth is not None:
            return unit
        shape = "bent as the colour is" if self.depth_distorted else "of an ideal camera"
        return f"{unit}; {shape}" + ("" if self.depth_distorted is None else f", from {self.origin}")

    @property
    def unit_in_words(self) -> str:
        """The depth's unit and who says so."""
        return f"{self.depth_scale:g} units a metre, {self._said_by}"

    @property
    def _said_by(self) -> str:
        if self.scale_origin:
            return f"from {self.scale_origin}"
        return "assumed, as no file says (scale in camera.json does)"


def given_camera(path: Path, size: tuple[int, int], intrinsics: Intrinsics | None) -> Camera:
    """Return the camera of the images in ``path``, (width, height) pixels, which only the user knows.

    Raises:
        DatasetError: ``intrinsics`` are not given, or cannot be.
    """
    width, height = size
    if intrinsics is None:
        guess = round(0.8 * max(size))
        raise DatasetError(
            f"{path}: its camera is not known; give --intrinsics FX FY CX CY, in pixels of its "
            f"{width}x{height} images (for many phones about "
            f"{guess} {guess} {0.5 * width - 0.5:g} {0.5 * height - 0.5:g})"
        )
    fx, fy, cx, cy = intrinsics
    given = f"--intrinsics {fx:g} {fy:g} {cx:g} {cy:g}"
    if not (all(map(math.isfinite, intrinsics)) and fx > 0.0 and fy > 0.0):
        raise DatasetError(f"{given}: expected positive focal lengths, in pixels")
    if not (0.0 <= cx < width and 0.0 <= cy < height):
        raise DatasetError(f"{given}: the centre lies outside the {width}x{height} images of {path}")
    if fault := camera_fault(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy):
        raise DatasetError(f"{given}: {fault} ({path})")
    return Camera(width, height, fx, fy, cx, cy)


def has_camera_file(folder: Path) -> bool:
    """Return whether ``folder`` has a camera file of one's own recording: it is no app's, then."""
    return any((folder / name).is_file() for name in CAMERA_FILES)


def find_camera_file(folders: Iterable[Path], names: Iterable[str] = CAMERA_FILES) -> Path:
    """Return the first of ``names`` in the first of ``folders`` that has one.

    Raises:
        DatasetError: there is none.
    """
    folders, names = list(folders), list(names)
    for folder in folders:
        for name in names:
            if (folder / name).is_file():
                return folder / name
    searched = " or ".join(str(folder) for folder in folders)
    like = (p.name for folder in folders if folder.is_dir() for p in sorted(folder.iterdir()) if p.is_file())
    others = [printable(name) for name in like if _LIKE_A_CAMERA.search(name)][:4]
    found = f" ({', '.join(others)}: such names are not read)" if others else ""
    raise DatasetError(f"{names[0]}: no camera file in {searched}{found}; write one, such as {JSON_EXAMPLE}")


def read_calibration(
    path: Path, *, depth_scale: float, size: tuple[int, int], intrinsics: Intrinsics | None = None
) -> Calibration:
    """Read a camera file.

    JSON holds ``w h fx fy cx cy scale`` (also below a key "camera"; also ``width height
    depth_scale distortion``, or Open3D's ``intrinsic_matrix``), and where depth is not registered also
    ``depth``, its own camera with ``w h fx fy cx cy distortion``, and ``T_color_depth``, a 4x4 matrix that
    takes points of the depth camera to the colour camera; ``depth_distorted`` is true where registered
    depth is bent as colour is. Text holds either one line ``fx fy cx cy [k1 k2 p1 p2 [k3]]`` or a 3x3 or
    4x4 matrix.

    Args:
        depth_scale: used where the file gives none.
        size: (width, height) of the colour images, pixels; used where the file gives none.
        intrinsics: go before the file's; its depth scale and distortion stay.

    Raises:
        DatasetError: the file is malformed or a value is out of range.
    """
    return calibration_of(
        camera_values(path), path, depth_scale=depth_scale, size=size, intrinsics=intrinsics
    )


def calibration_of(
    values: dict[str, Any],
    path: Path,
    *,
    depth_scale: float,
    size: tuple[int, int],
    intrinsics: Intrinsics | None = None,
) -> Calibration:
    """Do what :func:`read_calibration` does, of a file's values by their full names."""
    told, notes = "depth_scale" in values, (*values.pop("notes", ()), *lens_notes(values, path))
    origin = path.name
    if intrinsics is not None:
        values.update(zip(("fx", "fy", "cx", "cy"), intrinsics, strict=True))
        origin = f"--intrinsics and {path.name}"
    values = {"width": size[0], "height": size[1], "depth_scale": depth_scale, **values}
    colour = _lens(values, path, size)
    scale = _number(values["depth_scale"], "depth_scale", path)
    if scale <= 0.0:
        raise DatasetError(f"{path}: depth_scale is {scale:g}; it must be positive")
    if not _LEAST_SCALE <= scale <= _LARGEST_SCALE:
        raise DatasetError(
            f"{path}: depth_scale is {scale:g}; it is what a metre counts in the depth images, "
            f"{_LEAST_SCALE:g} to {_LARGEST_SCALE:g} (1000 for millimetres)"
        )
    depth, T_colour_depth = None, None
    if "depth" in values:
        if not isinstance(values["depth"], dict):
            raise DatasetError(f"{path}: depth is {shown(values['depth'])}; expected such as {JSON_EXAMPLE}")
        depth = _lens(in_full(values["depth"], path), path, None)
    if "T_color_depth" in values:
        T_colour_depth = _pose(values["T_color_depth"], path)
        depth = depth or colour
    distorted = values.get("depth_distorted")
    if not isinstance(distorted, bool | None):
        raise DatasetError(f"{path}: depth_distorted is {shown(distorted)}; it must be true or false")
    return Calibration(
        colour.camera,
        scale,
        colour.distortion,
        depth,
        T_colour_depth,
        distorted,
        origin=origin,
        scale_origin=path.name if told else "",
        notes=notes,
    )


def _lens(values: dict[str, Any], path: Path, size: tuple[int, int] | None) -> Lens:
    """Return the camera and distortion in ``values``, of pictures of (width, height) ``size``; None: any."""
    for key in ("width", "height", "fx", "fy", "cx", "cy"):
        if key not in values:
            raise DatasetError(f"{path}: {key} is missing; expected such as {JSON_EXAMPLE}")
        values[key] = _number(values[key], key, path)
        if key not in ("cx", "cy") and values[key] <= 0.0:
            down = ": y points down here; with depth and poses of a camera whose y points up, turn these, too"
            sign = down if key == "fy" and values[key] < 0.0 else ""
            raise DatasetError(f"{path}: {key} is {values[key]:g}; it must be positive{sign}")
    for key in ("width", "height"):
        if values[key] != int(values[key]):
            raise DatasetError(f"{path}: {key} is {values[key]:g}; it must be a whole number of pixels")
    distortion = values.get("distortion", ())
    if not isinstance(distortion, (list, tuple)) or len(distortion) not in (0, 4, 5, 8):
        raise DatasetError(
            f"{path}: distortion is {shown(distortion)}; expected a list k1 k2 p1 p2 [k3 [k4 k5 k6]]"
        )
    coefficients = tuple(_number(value, "distortion", path) for value in distortion)
    if any(abs(value) > _LARGEST_COEFFICIENT for value in coefficients):
        raise DatasetError(
            f"{path}: distortion is {shown(distortion)}; a coefficient is at most {_LARGEST_COEFFICIENT:g}"
        )
    values = {key: values[key] for key in ("width", "height", "fx", "fy", "cx", "cy")}
    if max(values["fx"], values["fy"]) < _SHORTEST_FOCAL and max(values["cx"], values["cy"]) <= 1.0:
        raise DatasetError(
            f"{path}: fx is {values['fx']:g} and cx {values['cx']:g}, as of normalised intrinsics "
            "(a focal length below a few pixels); multiply fx and cx by the width, fy and cy by the height"
        )
    # Of another size than the images it is wrong anyhow, which the first of them tells best.
    found = (values["width"], values["height"])
    fault = camera_fault(**values) if found == (size or found) else size_fault(**values)
    if fault:
        told = size is None or str(size[0]) in fault.rpartition("the ")[2]
        other = "" if told or size is None else f"; the images are {size[0]}x{size[1]}"
        raise DatasetError(f"{path}: {fault}{other}: are they of another size than the file's?")
    camera = Camera(
        int(values["width"]), int(values["height"]), *(values[key] for key in ("fx", "fy", "cx", "cy"))
    )
    return Lens(camera, coefficients if any(coefficients) else ())


def _pose(value: Any, path: Path) -> Float64:
    """Return the rigid motion [4, 4] that a camera file gives as 16 numbers, or four rows of four."""
    numbers = numbers_of(value, 16)
    T = None if numbers is None else rigid(np.array(numbers).reshape(4, 4))
    if T is None:
        raise DatasetError(
            f"{path}: T_color_depth is {shown(value)}; expected a rigid motion, four rows of four numbers "
            "that take points of the depth camera to the colour camera, in metres"
        )
    return T


def _number(value: Any, key: str, path: Path) -> float:
    number = finite_number(value)
    if number is None:
        raise DatasetError(f"{path}: {key} is {shown(value)}; it must be a finite number")
    return number
