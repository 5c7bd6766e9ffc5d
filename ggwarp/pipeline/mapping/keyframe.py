# SPDX-License-Identifier: Apache-2.0
"""Keyframes as mapping sees them: arrays on the device.

What is small of each stays there, a row of a few arrays; images are many, and in an :class:`ImageStore`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, overload

import cv2
import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry import se3
from ggwarp.kernels.losses.pixel_lines import BYTE_WEIGHT
from ggwarp.kernels.math import vec6
from ggwarp.kernels.raster.thinning import thin_planes
from ggwarp.objects.labels import as_runs, from_runs
from ggwarp.runtime.image_store import ImageStore
from ggwarp.runtime.state import FrameSource, State, Stateful, frame_checksum, into_array, reread
from ggwarp.runtime.streams import to_host
from ggwarp.types import Exposure, Float32, Float64, Frame

_NEUTRAL = Exposure()


@dataclass(frozen=True)
class KeyframeOrigin:
    """Where a keyframe comes from.

    Attributes:
        index: the frame's; negative: it is a view of an earlier map.
        has_depth: whether the frame came with depth.
        checksum: of the frame's picture and depth, see :func:`ggwarp.runtime.state.frame_checksum`.
    """

    index: int
    has_depth: bool
    checksum: int

    @property
    def is_earlier(self) -> bool:
        """Whether it is a view of an earlier map, whose pose and exposure are as they are."""
        return self.index < 0


@dataclass(frozen=True)
class Keyframe(KeyframeOrigin):
    """A frame the map is fitted to, on the device.

    Attributes:
        T_cw: [1] mat44, world to camera.
        pose_moments, pose_steps: [2] vec6 and [1] int, Adam's state of that pose.
        exposure: [1] vec6, see :mod:`ggwarp.kernels.photometric.affine_exposure`; 0: the map's own.
        exposure_moments, exposure_steps: as those of the pose.
        colour: [h, w, 3] uint8.
        depth: [h, w] float, metres, 0 = none.
        labels: [h, w] int class of each pixel; None where there is no mask.
        depth_weights: [h, w] uint8 how much each reading counts in the loss, 64 for one; None: all alike.
    """

    T_cw: wp.array
    pose_moments: wp.array
    pose_steps: wp.array
    exposure: wp.array
    exposure_moments: wp.array
    exposure_steps: wp.array
    colour: wp.array
    depth: wp.array
    labels: wp.array | None
    depth_weights: wp.array | None


IMAGES = ("colour", "depth", "labels", "depth_weights")
"""What of a keyframe is in the store."""


def upload(
    frame: Frame,
    T_wc: Float64,
    labels: Any,
    exposure: Exposure = _NEUTRAL,
    *,
    device: Any,
) -> Keyframe:
    """Copy ``frame``, seen from ``T_wc`` [4, 4], to the device.

    Args:
        labels: [h, w] int, there already or not, the class of each pixel; None where there is no mask.
        exposure: of the picture, where its fit starts.
    """
    T_cw = se3.inverse(T_wc).astype(np.float32)
    depth = np.zeros(frame.rgb.shape[:2], np.float32) if frame.depth is None else frame.depth
    weights = None if frame.depth is None else _loss_weights(frame)
    row: Any = vec6
    return Keyframe(
        index=frame.index,
        has_depth=frame.depth is not None,
        T_cw=wp.array(T_cw[None], dtype=wp.mat44, device=device),
        pose_moments=wp.zeros(2, dtype=row, device=device),
        pose_steps=wp.zeros(1, dtype=wp.int32, device=device),
        exposure=wp.array([[*exposure.log_gain, *exposure.offset]], dtype=row, device=device),
        exposure_moments=wp.zeros(2, dtype=row, device=device),
        exposure_steps=wp.zeros(1, dtype=wp.int32, device=device),
        colour=wp.array(frame.rgb, dtype=wp.uint8, device=device),
        depth=wp.array(depth, dtype=float, device=device),
        labels=wp.array(labels, dtype=int, device=device) if isinstance(labels, np.ndarray) else labels,
        depth_weights=None if weights is None else wp.array(weights, dtype=wp.uint8, device=device),
        checksum=frame_checksum(frame.rgb, frame.depth),
    )


def _loss_weights(frame: Frame) -> NDArray[np.uint8] | None:
    """Return how much each reading counts in the loss, [h, w] with 64 for one; None: all alike.

    What a frame states goes by the inverse variance, as registration's squares need it. An error that
    counts by its size goes by the inverse of the deviation, as that of a Laplace distribution. Readings
    count one in the mean: depth binds the map as much as without, beside colour.
    """
    assert frame.depth is not None
    readings = frame.depth > 0.0
    if frame.depth_weight is None or not readings.any():
        return None
    size = frame.rgb.shape[1], frame.rgb.shape[0]
    weights = np.sqrt(np.maximum(cv2.resize(frame.depth_weight, size, interpolation=cv2.INTER_AREA), 0.0))
    mean = float(weights[readings].mean())
    if mean <= 0.0 or np.ptp(weights[readings]) < 0.01 * mean:
        return None
    return np.rint(weights / (mean * BYTE_WEIGHT)).clip(0, 255).astype(np.uint8)


POSE = ("T_cw", "pose_moments", "pose_steps")
"""What a step of the pose changes."""
EXPOSURE = ("exposure", "exposure_moments", "exposure_steps")
"""What a step of the exposure changes."""

_FITTED = (*POSE, *EXPOSURE)
_FIRST_ROOM = 64
"""Keyframes that the arrays of what is fitted have room for at first; they double."""


class Keyframes(Sequence[Keyframe], Stateful):
    """All keyframes, numbered in the order in which they came.

    Attributes:
        origins: where each comes from.
    """

    def __init__(self, images: ImageStore) -> None:
        """Begin without any; their images go to ``images``, by number and name, which nobody else uses."""
        self.origins: list[KeyframeOrigin] = []
        self._fitted: dict[str, wp.array] = {}  # by name, [room, ...]: a row of each keyframe
        self._images = images
        self._left_out: dict[int, NDArray[np.uint8]] = {}  # packed
        self._packed_labels: dict[int, NDArray[np.uint16]] = {}  # those that have not changed since
        images.clear()

    def __len__(self) -> int:
        return len(self.origins)

    @overload
    def __getitem__(self, number: int) -> Keyframe: ...
    @overload
    def __getitem__(self, number: slice) -> list[Keyframe]: ...
    def __getitem__(self, number: int | slice) -> Keyframe | list[Keyframe]:
        if isinstance(number, slice):
            return [self[k] for k in range(len(self))[number]]
        number = range(len(self))[number]
        images: dict[str, Any] = dict.fromkeys(IMAGES)
        images |= {n: self._images.get((number, n)) for n in IMAGES if (number, n) in self._images}
        fitted = {name: self._row(name, number) for name in _FITTED}
        return Keyframe(**vars(self.origins[number]), **fitted, **images)

    def append(self, keyframe: Keyframe) -> None:
        """Add the next one; its images are kept as they are."""
        number = len(self)
        self.origins.append(KeyframeOrigin(keyframe.index, keyframe.has_depth, keyframe.checksum))
        for name in _FITTED:
            row, rows = getattr(keyframe, name), self._fitted.get(name)
            if rows is None or len(rows) == number:
                room = max(_FIRST_ROOM, 2 * number)
                self._fitted[name] = wp.zeros((room, len(row)), dtype=row.dtype, device=row.device)
                if rows is not None:
                    wp.copy(self._fitted[name], rows, count=rows.size)
            wp.copy(self._row(name, number), row)
        for name in IMAGES:
            if (image := getattr(keyframe, name)) is not None:
                self._images.put((number, name), image)

    def depth(self, number: int, *, step: int = 1) -> Float32:
        """Return every ``step``-th pixel of a row and column of keyframe ``number``'s depth, metres."""
        depth = self._images.get((number, "depth"))
        if step > 1:
            shape = tuple(len(range(step // 2, size, step)) for size in depth.shape)
            few = wp.empty((1, *shape), dtype=float, device=depth.device)
            thin_planes(depth.reshape((1, *depth.shape)), step=step, out=few, device=depth.device)
            depth = few[0]
        return to_host(depth)

    def label(self, number: int, labels: Any) -> None:
        """Replace the labels of keyframe ``number``, if any, by ``labels`` [h, w] int.

        An array of the device is the keyframe's from now on.
        """
        key = number, "labels"
        if key in self._images:
            if isinstance(labels, np.ndarray):
                labels = wp.array(labels, dtype=int, device=self._images.device)
            self._images.put(key, labels)
            self._packed_labels.pop(number, None)

    def leave_out(self, number: int, pixels: NDArray[np.bool_]) -> int:
        """Take the depth of ``pixels`` [h, w] from keyframe ``number``; return how many had one.

        In a view of an earlier map nothing is told of objects there, either: they are gone.
        """
        if not pixels.any():
            return 0
        key = number, "depth"
        array = self._images.get(key)
        depth = to_host(array)
        had = int(np.count_nonzero(pixels & (depth > 0.0)))
        if had:
            array.assign(np.where(pixels, np.float32(0), depth))
            self._images.put(key, array)
            bits = np.packbits(pixels)
            self._left_out[number] = self._left_out.get(number, np.zeros_like(bits)) | bits
            if self.origins[number].is_earlier and (number, "labels") in self._images:
                labels = to_host(self._images.get((number, "labels")))
                self.label(number, np.where(pixels, np.int32(-1), labels))
        return had

    @property
    def indices(self) -> list[int]:
        """The frames that they are."""
        return [origin.index for origin in self.origins]

    def state(self) -> State:
        """Return what was fitted and labelled; pictures go by reference to their frames."""
        for number in range(len(self)):
            key = number, "labels"
            if key in self._images and number not in self._packed_labels:
                self._packed_labels[number] = as_runs(to_host(self._images.get(key)))
        return {
            "indices": self.indices,
            "checksums": [origin.checksum for origin in self.origins],
            "has_depth": [origin.has_depth for origin in self.origins],
            "labels": [self._packed_labels.get(number) for number in range(len(self))],
            "left_out": {str(number): bits.copy() for number, bits in self._left_out.items()},
            "fitted": {name: to_host(rows)[: len(self)].copy() for name, rows in self._fitted.items()},
        }

    def restore(self, state: State, frames: FrameSource) -> None:
        """Read the frames again, and take over what was fitted and labelled.

        Views of an earlier map are not compared with what they were: another device renders other last bits.
        """
        self.origins.clear()
        self._left_out.clear()
        self._images.clear()
        names = ("indices", "checksums", "has_depth", "labels")
        rows = zip(*(state[name] for name in names), strict=True)
        for number, (index, checksum, has_depth, packed) in enumerate(rows):
            frame = frames(index) if index < 0 else reread(frames, index, checksum, with_depth=has_depth)
            labels = None if packed is None else from_runs(packed, frame.rgb.shape[:2])
            keyframe = upload(frame, np.eye(4), labels, device=self._images.device)
            for name in _FITTED:
                into_array(getattr(keyframe, name), state["fitted"][name][number])
            self.append(keyframe)
            if (bits := state["left_out"].get(str(number))) is not None:
                pixels = np.unpackbits(bits, count=frame.rgb.shape[0] * frame.rgb.shape[1])
                self.leave_out(number, pixels.reshape(frame.rgb.shape[:2]).astype(bool))

    def pose(self, number: int) -> Float64:
        """Return the camera-to-world pose [4, 4] of keyframe ``number`` (-1: the newest) as it is now."""
        T_cw = to_host(self._row("T_cw", number))[0].astype(np.float64)
        return se3.inverse(se3.orthonormalised(T_cw))

    def poses(self) -> dict[int, Float64]:
        """Return the poses, by the frame's index, of all but an earlier map's views."""
        return {o.index: self.pose(number) for number, o in enumerate(self.origins) if not o.is_earlier}

    def set_pose(self, number: int, T_wc: Float64) -> None:
        """Put keyframe ``number`` at ``T_wc`` [4, 4]; what Adam remembers of its pose is in its camera."""
        T_cw = se3.inverse(se3.orthonormalised(T_wc))
        self._row("T_cw", number).assign(T_cw[None].astype(np.float32))

    def move(self, motions: Float64) -> None:
        """Move each keyframe by its motion [n, 4, 4] of the world; those that stay keep every bit."""
        for number, motion in enumerate(motions):
            if (motion != np.eye(4)).any():
                self.set_pose(number, motion @ self.pose(number))

    def exposure(self, number: int) -> Exposure:
        """Return the exposure of keyframe ``number`` (-1: the newest) as it is now."""
        values = to_host(self._row("exposure", number))[0].tolist()
        return Exposure(tuple(values[:3]), tuple(values[3:]))

    def _row(self, name: str, number: int) -> Any:
        return self._fitted[name][range(len(self))[number]]


class KeyframeBuffer:
    """Holds one keyframe, always in the same arrays: recorded work reads it there."""

    def __init__(self) -> None:
        self._arrays: dict[str, Any] = {}

    def load(self, keyframe: Keyframe) -> Keyframe:
        """Return ``keyframe`` with its arrays copied here, on the device's current stream."""
        buffered: dict[str, Any] = {}
        for name in (f.name for f in fields(keyframe)):
            array = getattr(keyframe, name)
            if isinstance(array, wp.array):
                if name not in self._arrays:
                    self._arrays[name] = wp.empty_like(array)
                wp.copy(self._arrays[name], array)
                buffered[name] = self._arrays[name]
        return replace(keyframe, **buffered)

    def store(self, keyframe: Keyframe, names: tuple[str, ...]) -> None:
        """Copy the arrays ``names``, which the recorded work changed, back to ``keyframe``."""
        for name in names:
            wp.copy(getattr(keyframe, name), self._arrays[name])
