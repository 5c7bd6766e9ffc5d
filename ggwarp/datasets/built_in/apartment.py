# SPDX-License-Identifier: Apache-2.0
"""The built-in apartment as a data set: a walk in a ring through its rooms, perfectly seen or by a Kinect."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from ggwarp.datasets.built_in.apartment_plan import apartment_scene
from ggwarp.datasets.built_in.apartment_walk import apartment_trajectory, person_at, way_points
from ggwarp.datasets.built_in.faults import SensorFaults
from ggwarp.datasets.built_in.kinect import KINECT_CAMERA, kinect_depth
from ggwarp.datasets.built_in.person import person_shapes
from ggwarp.datasets.built_in.scene import Shape
from ggwarp.datasets.built_in.synthetic import SyntheticScene
from ggwarp.types import Float32

KINECT_FAULTS = SensorFaults(colour_noise=3.0, exposure_drift=0.2, exposure_swings=7.0)
"""What besides its depth is wrong with the Kinect: noise, and an exposure that swings every 11 seconds."""


class SyntheticApartment(SyntheticScene):
    """An apartment of 8.6 x 9.4 m, seen on one walk through all its rooms and on to where it began."""

    def __init__(
        self,
        *,
        frames: int = 2400,
        kinect: bool = False,
        person: bool = False,
        faults: SensorFaults = SensorFaults(),  # noqa: B008 - frozen
        **options: Any,
    ) -> None:
        """Lay the apartment out.

        Args:
            frames: frames along the walk: 80 seconds.
            kinect: depth is a Kinect's, and :data:`KINECT_FAULTS` hold where ``faults`` says nothing else.
            person: someone walks through the living room, the corridor and the study.
            faults: of the camera.
            options: see :class:`~ggwarp.datasets.built_in.synthetic.SyntheticScene`.
        """
        if kinect:
            own, none = vars(faults), SensorFaults()
            said = {f.name: own[f.name] for f in fields(faults) if own[f.name] != getattr(none, f.name)}
            faults = replace(KINECT_FAULTS, **said)
        name = "apartment" + ("-kinect" if kinect else "") + ("-person" if person else "")
        trajectory = apartment_trajectory(frames) if frames > 0 else np.empty(0)
        super().__init__(name, apartment_scene(), trajectory, camera=KINECT_CAMERA, faults=faults, **options)
        self._names = self.class_names
        if person:
            self.class_names = {**self._names, len(self._names) + 1: "person"}
            self.ids = np.append(self.ids, np.int32(len(self.class_names)))
        self._times = way_points(max(frames, 1))
        self._kinect, self._person = kinect, person

    def _moving(self, index: int) -> list[Shape]:
        where = person_at(float(self._times[index])) if self._person else None
        return person_shapes(self._names, *where) if where else []

    def _sensed(self, depth: Float32, index: int) -> Float32:
        if self._kinect:
            depth = kinect_depth(depth, self.camera, index, self.faults.seed)
        return super()._sensed(depth, index)
