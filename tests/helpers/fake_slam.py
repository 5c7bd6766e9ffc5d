# SPDX-License-Identifier: Apache-2.0
"""A system that tracks and maps nothing, as the command sees it."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace

import numpy as np

from ggwarp.map.gaussians import Gaussians
from ggwarp.objects.inventory import inventory
from ggwarp.objects.linear_classifier import LinearClassifier
from ggwarp.types import Rendered, StepReport, Verdict

WIDTH, HEIGHT, FRAMES = 64, 48, 6


class FakeSlam:
    """Knows every pose, renders grey, and does on each frame what the test asks for."""

    on_track = staticmethod(lambda index: None)
    on_map = staticmethod(lambda index: None)
    on_refine = staticmethod(lambda done: None)
    sequential_only = False
    can_refine = True
    has_state = False
    localiser = earlier = None

    def __init__(
        self,
        config,
        camera,
        sensor_camera,
        *,
        device,
        scheduler=None,
        images=None,
        map_budget=None,
        earlier=None,
    ):
        self.camera, self.device, self.scheduler = camera, device, scheduler
        self.refined = 0
        self.keyframe_indices, self.voting_indices = [0, 1], [3]
        self.loops = SimpleNamespace(stay_open="")
        self.counts = {"tracking_keyframes": 1, "mapping_keyframes": 1, "frames_lost": 0}

    def track_frame(self, frame):
        self.on_track(frame.index)
        return SimpleNamespace(frame=frame)

    def map_frame(self, tracked, waiting=None):
        self.on_map(tracked.frame.index)
        return self._report(tracked.frame, 3)

    def leave_unmapped(self, tracked):
        return self._report(tracked.frame, 0)

    def skip_frame(self):
        pass

    def fitted_poses(self):
        return {}

    def in_two_threads(self):
        return contextlib.nullcontext()

    def finish(self):
        pass

    def refine(self):
        self.refined += 1
        self.on_refine(self.refined)

    def _report(self, frame, iterations):
        T_wc = np.eye(4) if frame.T_wc is None else frame.T_wc
        keyframe = {0: "tracking", 1: "mapping"}.get(frame.index, "")
        return StepReport(
            frame.index, frame.timestamp, T_wc, Verdict.CONVERGED, "", 1.0, 0.0, keyframe, 1.0, 2.0,
            iterations, 7, loss=0.1, latency_ms=1.0,
        )  # fmt: skip

    def render(self, T_wc):
        shape = (self.camera.height, self.camera.width)
        plane = np.full(shape, 2.0, np.float32)
        ids = np.full(shape, 4, np.int32)
        identity = np.zeros((*shape, 16), np.float32)
        grey, opaque = np.full((*shape, 3), 0.5, np.float32), np.ones(shape, np.float32)
        return Rendered(grey, plane, plane, opaque, identity, ids)

    def map_parts(self):
        yield self.map_arrays()

    def map_arrays(self):
        ids = np.array([0, 0, 0, 4, 4, 4, 4], np.int32)
        values = np.arange(21, dtype=np.float32).reshape(7, 3)
        identities = np.random.default_rng(0).normal(size=(7, 16)).astype(np.float32)
        quats = np.tile(np.float32([1, 0, 0, 0]), (7, 1))
        return Gaussians(values, quats, values, values[:, 0], values, ids, identities)

    def objects(self, names):
        arrays = self.map_arrays()
        return inventory(arrays.means, arrays.colours, arrays.object_ids, names=names)

    def linear_classifier(self):
        return LinearClassifier(np.ones((2, 16), np.float32), np.zeros(2, np.float32), np.array([0, 4]))


def only_line(capsys) -> str:
    """Return the one line of standard error; a traceback would be many."""
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    return lines[0]
