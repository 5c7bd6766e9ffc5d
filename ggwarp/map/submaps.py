# SPDX-License-Identifier: Apache-2.0
"""Submaps: a map that is larger than memory, of which only what is in view is on the device.

A keyframe joins the submap whose middle it sees, and begins one where there is none: its middle is what the
keyframe looks at. Their number grows with the scene, not with time. A Gaussian belongs to the submap whose
middle is nearest. While the map exceeds its budget, the submap that has been out of view longest is parked:
its Gaussians, with all that the optimiser remembers of them, go to a file bit by bit, and come back before
anything looks where they are. Keyframes that see parked Gaussians must not be fitted meanwhile: what else
they show would make up for these. Who fits them visits them first.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry import se3, sim3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pixel_grid import PixelGrid
from ggwarp.geometry.view_volume import COLUMNS, ROWS, Bools, ViewVolume, median_reading, reach_of, same_reach
from ggwarp.map.cells import Cells, nearest
from ggwarp.map.gaussian_map import GROWTH, GaussianMap
from ggwarp.map.submap import MapBudget, Submap
from ggwarp.runtime.image_store import ImageStore
from ggwarp.runtime.state import FrameSource, State, Stateful
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float32, Float64, Rendered

log = logging.getLogger(__name__)

_MARGIN = 0.3
"""Submaps come back when they are this close to the view, metres: as far as a hand-held camera that turns by
60 degrees a second moves what is three metres away within a frame of 30 a second, and twice that."""

_WORK = 832
"""Bytes that rendering takes for a Gaussian with identity besides its own: 84 of its projection, 124 of its
gradients, 32 of the binning and 148 in each of four tiles."""

_OPAQUE = 0.95
"""Nothing is looked for behind pixels that are more opaque than this."""

_SLACK = 0.1
"""What a parked submap hides is found by balls larger by this, metres, so that it is known the next time."""

_CHUNK = 256
"""Keyframes that are looked at together."""


class Submaps(Stateful):
    """Keeps of a map on the device what is in view, and of the rest what the budget has room for.

    Who writes the map or looks at it calls :meth:`show` before, from where it looks.

    Attributes:
        visited: the keyframes that :meth:`visit` was last called with.
    """

    STATE = (
        "_submaps", "_submap_of", "_poses", "_reaches", "_views", "_looked_through", "_owners",
        "_view", "visited",
    )  # fmt: skip

    def __init__(self, gaussians: GaussianMap, camera: Camera, budget: MapBudget | None = None) -> None:
        """Begin without keyframes.

        Args:
            gaussians: the map, empty. camera: of the keyframes and of all views.
            budget: None: all of the map stays on the device.
        """
        self._map, self._budget = gaussians, budget
        self._volume, self._grid = ViewVolume(camera), PixelGrid.of(camera)
        self._store = ImageStore(device=gaussians.device, budget=0, folder=budget and budget.folder, level=0)
        self._submaps: list[Submap] = []
        self._submap_of = np.zeros(0, np.int32)  # by keyframe, as the next two
        self._poses, self._reaches = np.zeros((0, 4, 4)), np.zeros((0, ROWS, COLUMNS), np.float32)
        self._views, self._looked_through, self._told = 0, -1, False
        self._view, self.visited = (np.eye(4), same_reach(0.0)), list[int]()
        self._owners = np.zeros(0, np.int32)  # by Gaussian on the device, when they were looked through
        self._changed()

    def _changed(self) -> None:
        self._balls: tuple[Float64, Float64, NDArray[np.intp]] | None = None
        self._hidden: Bools | None = None

    @property
    def count(self) -> int:
        """Gaussians of the whole map."""
        return self._map.count + sum(submap.parked for submap in self._submaps)

    @property
    def parked(self) -> list[int]:
        """The numbers of the submaps that are in the file."""
        return [number for number, submap in enumerate(self._submaps) if submap.parked]

    def add(self, T_wc: Float64, depth: Float32 | None, *, bounded: bool = True) -> None:
        """Take in the next keyframe, before the map has its Gaussians.

        Args:
            T_wc: [4, 4] its pose.
            depth: [h, w] metres, 0 = none; None: nothing is known of it.
            bounded: whether it sees nothing beyond that; it may where depth is an estimate.
        """
        distance = 0.0 if depth is None else median_reading(self._grid.thinned(depth))
        middle = T_wc[:3, 3] + distance * T_wc[:3, 2]
        reach = reach_of(depth) if bounded and depth is not None else same_reach(math.inf)
        number = self._looked_at(T_wc, reach, middle)
        if number is None:
            number = len(self._submaps)
            self._submaps.append(Submap(middle, Cells.at(middle), self._views, around=Cells.at(middle)))
        self.hold(number)
        self._submap_of = np.append(self._submap_of, np.int32(number))
        self._poses = np.concatenate([self._poses, T_wc[None]])
        self._reaches = np.concatenate([self._reaches, reach[None]])
        self._changed()

    def show(self, T_wc: Float64, depth: Float32 | None = None) -> None:
        """Bring all that a view may show to the device; park what else there is no room for.

        Args:
            T_wc: [4, 4] the pose of the view.
            depth: [h, w] what it sees, metres, 0 = none; None: that is not known.
        """
        if self._budget is None or not self._submaps:
            return
        self._views += 1
        self._view = T_wc, same_reach(self._reaches.max()) if depth is None else reach_of(depth)
        for number in sorted(self._in_view(*self._view)):
            self._submaps[number].seen = self._views
            self.hold(number)
        self._make_room()

    def show_rendered(self, T_wc: Float64, look: Callable[[], Rendered]) -> None:
        """Bring to the device what a view shows of which nothing else is known, by looking at what is there.

        Args:
            T_wc: [4, 4] the pose of the view.
            look: renders it.
        """
        if not self.parked:
            return self.show(T_wc)
        farthest = self._reaches.max()
        while True:
            rendered = look()
            opaque = rendered.opacity > _OPAQUE
            depth = np.where(opaque, rendered.median_depth, farthest).astype(np.float32)
            missing = self._in_view(T_wc, reach_of(depth)) & {*self.parked}
            if not missing:
                return self.show(T_wc, depth)
            # What is nearest may hide the others.
            self.hold(min(missing, key=lambda n: self._submaps[n].cells.distance(T_wc[:3, 3])))

    def hold(self, number: int) -> None:
        """Bring the Gaussians of submap ``number`` to the device, if they are parked."""
        submap = self._submaps[number]
        if not submap.parked:
            return
        self._put_into(self._map, number)
        submap.parked, submap.motions = 0, []
        self._changed()

    def hold_view(self, keyframe: int) -> None:
        """Bring those Gaussians to the device that a keyframe sees."""
        for number in sorted(self._seen_by([keyframe])):
            self.hold(number)

    def hidden_keyframes(self) -> Bools | None:
        """Return [k] which keyframes see any of what is parked; None: none does."""
        if self._hidden is None:
            self._hidden = np.zeros(len(self._submap_of), bool)
            for submap in (self._submaps[number] for number in self.parked):
                self._hidden[: len(submap.hides)] |= submap.hides
        return self._hidden if self._hidden.any() else None

    def of_keyframe(self, keyframe: int) -> int:
        """Return the submap of a keyframe."""
        return int(self._submap_of[keyframe])

    def keyframes_of(self, number: int) -> NDArray[np.intp]:
        """Return the keyframes of a submap, rising."""
        return np.flatnonzero(self._submap_of == number)

    def visit(self, keyframes: Iterable[int]) -> None:
        """Bring all that some keyframes see to the device, where it stays until the next visit."""
        self.visited = list(keyframes)
        for keyframe in self.visited:
            self.hold_view(keyframe)
        self._make_room()

    def move(self, motions: Float64) -> None:
        """Let all of the map follow its keyframes, by the world's similarities ``motions`` [k, 4, 4]."""
        self._map.move(motions)
        for k, motion in enumerate(motions):
            self._poses[k] = sim3.moved_pose(motion, self._poses[k])
        for number, submap in enumerate(self._submaps):
            first = motions[np.argmax(self._submap_of == number)]
            submap.middle = se3.transform_points(first, submap.middle[None])[0]
            if submap.parked:
                submap.motions.append(motions[submap.births])
                submap.cells = submap.cells.moved(submap.motions[-1])
            submap.hides = np.zeros(0, bool)  # by keyframes as they were
            if submap.parked:
                self._find_hidden(submap)
        self._looked_through = -1
        if self._budget is not None:
            self._look_through()
        self._changed()

    def parts(self) -> Iterator[GaussianMap]:
        """Yield all of the map, part by part: what is on the device, and every parked submap in turn."""
        yield self._map
        for number in self.parked:
            room = self._submaps[number].parked
            part = GaussianMap(device=self._map.device, has_identity=self._map.has_identity, capacity=room)
            self._put_into(part, number)
            yield part

    def state(self) -> State:
        """Return all of it; the rows of what is parked are read from the file when the state is written."""
        names = self._map.fields
        rows = {str(n): {name: self._store.joined([(n, name)]) for name in names} for n in self.parked}
        return super().state() | {"rows": rows}

    def restore(self, state: State, frames: FrameSource) -> None:
        """Take all of it over; what is parked goes to a file again, unless there is no budget any more."""
        super().restore(state, frames)
        self._store.clear()
        for number in self.parked:
            for name, rows in state["rows"][str(number)].items():
                dtype = self._map.fields[name].dtype
                self._store.put(
                    (number, name), wp.array(np.asarray(rows), dtype=dtype, device=self._map.device)
                )
            if self._budget is None:
                self.hold(number)
        self._changed()

    def _looked_at(self, T_wc: Float64, reach: Float32, middle: Float64) -> int | None:
        """Return the submap whose middle is in view, the nearest to ``middle`` [3]; None: there is none."""
        if not self._submaps:
            return None
        middles = np.stack([submap.middle for submap in self._submaps])
        seen = self._volume.touches(se3.inverse(T_wc), reach, middles, np.zeros(len(middles)))
        distances = np.where(seen, np.linalg.norm(middles - middle, axis=1), np.inf)
        nearest = int(np.argmin(distances))
        return nearest if seen[nearest] else None

    def _in_view(self, T_wc: Float64, reach: Float32) -> set[int]:
        """Return the submaps that a camera at ``T_wc`` may see whose picture reaches so far."""
        if self._balls is None:
            cells = [submap.cells for submap in self._submaps]
            owners = np.repeat(np.arange(len(cells)), [len(c.radii) for c in cells])
            centres = np.concatenate([c.centres for c in cells])
            self._balls = centres, np.concatenate([c.radii for c in cells]) + _MARGIN, owners
        centres, radii, owners = self._balls
        return {*owners[self._volume.touches(se3.inverse(T_wc), reach, centres, radii)].tolist()}

    def _seen_by(self, keyframes: Iterable[int]) -> set[int]:
        """Return the submaps that any of some keyframes may see."""
        return {n for k in keyframes for n in self._in_view(self._poses[k], self._reaches[k])}

    def _find_hidden(self, submap: Submap) -> None:
        """Find out which keyframes may see any of a submap; where it is as it was, of the new ones alone."""
        cells = submap.cells
        if not (submap.around.hold(cells) and cells.grown(2.0 * _SLACK).hold(submap.around)):
            submap.around, submap.hides = cells.grown(_SLACK), np.zeros(0, bool)
        around, seen = submap.around, [submap.hides]
        for k in range(len(submap.hides), len(self._poses), _CHUNK):
            T_wc, reach = self._poses[k : k + _CHUNK], self._reaches[k : k + _CHUNK]
            T_cw = np.asarray(np.linalg.inv(T_wc), np.float64)
            seen.append(np.any(self._volume.touches(T_cw, reach, around.centres, around.radii), axis=1))
        submap.hides = np.concatenate(seen)

    def _make_room(self) -> None:
        """Park what has been out of view longest, until the rest fits; not what is in view."""
        assert self._budget is not None
        most = int(self._budget.size / (GROWTH * (self._map.row_bytes + _WORK)))
        if self._map.count <= most:
            return
        self._look_through()
        # The newest keyframe is fitted next, wherever the camera looks meanwhile.
        needed = self._in_view(*self._view) | self._seen_by([*self.visited, len(self._poses) - 1])
        others = [n for n, s in enumerate(self._submaps) if not s.parked and n not in needed]
        for number in sorted(others, key=lambda n: self._submaps[n].seen):
            if self._map.count > most:
                self._park(number)
        if self._map.count > most and not self._told:
            self._told = True
            log.warning("what is in view takes more memory than the map may have: it is all kept")

    def _look_through(self) -> None:
        """Find out where the Gaussians on the device are, if any came or went."""
        if self._looked_through == self._map.version:
            return
        self._looked_through = self._map.version
        means, log_scales = (to_host(self._map.fields[n])[: self._map.count] for n in ("means", "log_scales"))
        self._owners = nearest(means, [submap.middle for submap in self._submaps])
        for number, submap in enumerate(self._submaps):
            if not submap.parked:
                own = self._owners == number
                submap.cells = Cells.around(means[own], log_scales[own])
        self._changed()

    def _park(self, number: int) -> None:
        own, submap = self._owners == number, self._submaps[number]
        if not own.any():
            return
        rows = self._map.take_out(own)
        for name, array in rows.items():
            self._store.put((number, name), array)
        submap.parked, submap.births = int(own.sum()), np.unique(to_host(rows["keyframe_ids"]))
        self._find_hidden(submap)
        self._owners, self._looked_through = self._owners[~own], self._map.version
        self._changed()

    def _rows(self, number: int) -> dict[str, wp.array]:
        return {name: self._store.get((number, name)) for name in self._map.fields}

    def _put_into(self, gaussians: GaussianMap, number: int) -> None:
        """Add the Gaussians of a parked submap to ``gaussians``, where loops have moved them since."""
        begin = gaussians.count
        gaussians.put_back(self._rows(number))
        for own in self._submaps[number].motions:
            motions = np.tile(np.eye(4), (len(self._submap_of), 1, 1))
            motions[self._submaps[number].births] = own
            gaussians.move(motions, begin=begin)
