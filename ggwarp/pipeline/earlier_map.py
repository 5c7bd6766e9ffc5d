# SPDX-License-Identifier: Apache-2.0
"""The map of an earlier run as the beginning of another one.

A run folder's map and trajectory are enough. The map is rendered from where the camera was: such views are
what frames are found by, what their depth is registered to, and what the map is fitted to beside the new
frames, so that it does not forget what these do not show.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ggwarp.geometry.camera import Camera
from ggwarp.io.guarded import FileError
from ggwarp.map.gaussians import Gaussians
from ggwarp.map.renderer import Renderer
from ggwarp.pipeline.loops.features import FeatureExtractor
from ggwarp.pipeline.loops.localisation import Localiser, frame_of, view_index
from ggwarp.pipeline.loops.places import Place, far_enough
from ggwarp.pipeline.loops.surface_registration import Surface
from ggwarp.pipeline.loops.tracking_side import TrackingLoops
from ggwarp.pipeline.mapping.mapper import Mapper
from ggwarp.pipeline.slam_config import SlamConfig
from ggwarp.pipeline.surface_points import saved_points, surface_points
from ggwarp.pipeline.tracking.point_map import TrackableMap
from ggwarp.pipeline.tracking.preprocess import ObservationConfig
from ggwarp.pipeline.tracking.relocalisation import SmallViews
from ggwarp.pipeline.tracking.tracker import RemembersViews, Tracker
from ggwarp.results.frame_table import read_frames
from ggwarp.results.saved_run import SavedRun
from ggwarp.runtime.state import FrameSource
from ggwarp.types import Float32, Float64, Frame, Rendered

_LEAST_SHOWN = 0.2
"""A view is of use where the map shows surface in so much of it."""


class EmptyMapError(ValueError):
    """An earlier run's map shows nothing from where its camera was: one line."""


@dataclass(frozen=True)
class MapParts:
    """The parts of a system that know its map, all of them empty."""

    mapper: Mapper
    points: TrackableMap
    tracker: Tracker
    loops: TrackingLoops


def enter_map(
    run: SavedRun, config: SlamConfig, cameras: tuple[Camera, Camera], parts: MapParts
) -> Localiser:
    """Fill the ``parts`` with the map of ``run``; return what finds the first frame in it.

    Args:
        cameras: of the new frames' pictures and of their sensor depth.

    Raises:
        EmptyMapError: there is nothing to find a frame by.
    """
    (camera, sensor_camera), mapper = cameras, parts.mapper
    device = mapper.map.device
    mapper.map.append(_entering(run, mapper))
    places: list[Place] = []
    views: dict[int, Frame] = {}
    shown: list[tuple[Float32, Float64]] = []
    for place, frame, rendered in _views(run, mapper, cameras, config.gicp):
        mapper.rehearse(frame, place.T_wc, rendered)
        if isinstance(parts.tracker, RemembersViews):
            parts.tracker.remember(frame, place.T_wc)
        places.append(place)
        views[frame.index] = frame
        assert frame.depth is not None, "of a render"
        shown.append((frame.depth, place.T_wc))
    if not places:
        raise EmptyMapError(f"{run.folder}: its map shows nothing from where its camera was")
    tracked = saved_points(run)
    if tracked is None:
        spacing = parts.points.distance
        tracked = surface_points(run.gaussians, shown, camera, config.gicp, spacing=spacing, device=device)
    parts.points.add(tracked, np.eye(4), places[0].index)
    parts.loops.adopt(places)
    renderer: list[Renderer] = []

    def render(T_wc: Float64) -> Rendered:
        if not renderer:
            renderer.append(Renderer(mapper.map, camera, identity=False))
        renderer[0].render(T_wc)
        return renderer[0].picture()

    name = str(run.folder)
    return Localiser(config, camera, sensor_camera, places, views, render, name=name, device=device)


def with_views(frames: FrameSource, localiser: Localiser | None) -> FrameSource:
    """Return what reads ``frames`` and, by their negative indices, an earlier map's views."""
    if localiser is None:
        return frames
    return lambda index: localiser.views[index] if index < 0 else frames(index)


def _entering(run: SavedRun, mapper: Mapper) -> Gaussians:
    """Return the Gaussians of ``run`` as they enter the map of ``mapper``."""
    gaussians = replace(run.gaussians, keyframe_ids=np.zeros(len(run.gaussians), np.int32))
    if mapper.objects is not None:
        return mapper.objects.adopt(gaussians, run.objects)
    return gaussians


def _views(
    run: SavedRun, mapper: Mapper, cameras: tuple[Camera, Camera], sampling: ObservationConfig
) -> Iterator[tuple[Place, Frame, Rendered]]:
    """Yield what the map shows from where its camera was, all over, the last poses first."""
    extractor, pictures = FeatureExtractor(*cameras), SmallViews(cameras[1])
    known: list[Place] = []
    for row, number in reversed(list(enumerate(_frame_numbers(run)))):
        T_wc = run.poses[row]
        if not all(far_enough(place, T_wc) for place in known):
            continue
        rendered = mapper.render(T_wc)
        frame = frame_of(rendered, view_index(number))
        assert frame.depth is not None, "of a render"
        there = frame.depth > 0.0
        if np.mean(there) < _LEAST_SHOWN:
            continue
        depth = float(np.median(frame.depth[there]))
        surface = Surface.shown_by(frame.depth, cameras[0], sampling, device=mapper.map.device)
        features, small = extractor.extract(frame), pictures.view(frame)
        place = Place(frame.index, T_wc, depth, features, small, surface)
        known.append(place)
        yield place, frame, rendered


def _frame_numbers(run: SavedRun) -> list[int]:
    """Return the frame of each pose of ``run``, rising; its row where the table of frames does not say."""
    try:
        numbers = read_frames(run.folder).tracked().indices()
    except FileError:
        numbers = []
    rising = all(a < b for a, b in zip([-1, *numbers], numbers, strict=False))
    return numbers if rising and len(numbers) == len(run.poses) else list(range(len(run.poses)))
