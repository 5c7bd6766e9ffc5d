# SPDX-License-Identifier: Apache-2.0
"""A run's configuration: the command's options and the owners' dataclasses, composed.

Every part of the system keeps its options beside it (:class:`GicpConfig`,
:class:`KeyframeConfig`, :class:`MapperConfig`); this module puts them under one roof, names the
presets, and settles what was left open (device, image scale).
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ggwarp.datasets.built_in.faults import SensorFaults
from ggwarp.geometry.camera import Camera
from ggwarp.io.toml import TomlError, merged, read_toml
from ggwarp.pipeline.mapping.keyframe_window import WindowConfig
from ggwarp.pipeline.mapping.mapper import MapperConfig
from ggwarp.pipeline.slam import KeyframePolicyKind, SlamConfig
from ggwarp.pipeline.tracking.gicp import GicpConfig
from ggwarp.pipeline.tracking.initialisation import InitialisationConfig
from ggwarp.pipeline.tracking.keyframe_policy import CovisibilityConfig, KeyframeConfig
from ggwarp.pipeline.tracking.point_map import TrackableConfig
from ggwarp.pipeline.tracking.pose_refinement import RefinementConfig
from ggwarp.pipeline.tracking.tracker import TrackerError, tracker_factory

Preset = Literal["gg-slam", "gs-icp", "monogs", "fast", "quality"]
MasksKind = Literal["tracked", "untracked"]
PolicyChoice = Literal["auto", "overlap", "covisibility"]

_CPU_PIXELS = 50_000  # what two cores can map at a few frames a second
_MIN_SIDE = 16  # pixels: one tile


class ConfigError(ValueError):
    """An option cannot be used: one line for the user, with the option, the value and the remedy."""


@dataclass(frozen=True)
class RunConfig:
    """Everything that decides a run."""

    seq: str | None = None
    """A sequence's name, looked up under the data root, or its folder."""

    data: Path | None = None
    """Data root; default: $GGWARP_DATA, else ./data."""

    masks: str | None = None
    """Folder of per-frame object masks, or none; default: those beside the images, if any; untracked: those,
    and --masks-kind untracked."""

    masks_kind: MasksKind = "tracked"
    """untracked: the masks' ids say nothing across frames, as image segmenters write them; objects are found
    again by the map."""

    out: Path | None = None
    """Run folder; default: runs/SEQ/UTC-TIME, linked as runs/latest."""

    mono: bool = False
    """Leave depth images aside: one camera, and a map without a scale of its own; always so without any."""

    intrinsics: tuple[float, float, float, float] | None = None
    """fx fy cx cy of one's own recording, in pixels of its native size (integers are pixel centres); default:
    its camera file's."""

    device: str = "auto"
    """auto (CUDA if there is one), cpu or cuda:N."""

    preset: Preset = "gg-slam"
    """Where all other options start from: gs-icp learns no objects; monogs tracks by rendering and fits poses
    with the map; fast and quality map less and more."""

    tracker: str = "gicp"
    """How poses are found: gicp registers depth to the map's points; photometric looks for the pose at which
    the map looks like the picture; hybrid asks colour where geometry leaves the pose uncertain; ground-truth
    takes the data set's own."""

    frames: str | None = None
    """Slice of the sequence, A:B or A:B:STEP; default: all of it."""

    scale: float | None = None
    """Image scale, above 0 and at most 1; default: 1 on CUDA, about 50,000 pixels on a CPU."""

    fps: float | Literal["uncapped"] | None = None
    """Live mode: frames arrive this many times a second, or whenever the tracker is ready (uncapped);
    default: a fixed amount of mapping a frame."""

    pipelined: Literal["auto", "on", "off"] = "auto"
    """Track and map at the same time, in two threads; auto: with --fps uncapped."""

    refine: int = 0
    """Mapping iterations after the last frame."""

    save_renders: int | None = None
    """Save the renders of every Nth frame, 0 for none; default: of about ten frames."""

    use_identity: bool = True
    """Learn which object each Gaussian belongs to."""

    built_in: SensorFaults = field(default_factory=SensorFaults)
    """What is wrong with the camera of a built-in scene (--seq office, wall); without options nothing is."""

    gicp: GicpConfig = field(default_factory=GicpConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    initialisation: InitialisationConfig = field(default_factory=InitialisationConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    trackable: TrackableConfig = field(default_factory=TrackableConfig)
    mapper: MapperConfig = field(default_factory=MapperConfig)
    policy: PolicyChoice = "auto"
    """Keyframes are chosen by overlap with the trackable points (GG-SLAM), or by covisibility, and kept in
    a window that is fitted together (MonoGS); auto: by covisibility where --tracker photometric keeps no
    points."""
    covisibility: CovisibilityConfig = field(default_factory=CovisibilityConfig)
    window: WindowConfig = field(default_factory=WindowConfig)

    def slam(self) -> SlamConfig:
        """Return the part that configures :class:`ggwarp.pipeline.slam.Slam`."""
        return SlamConfig(
            tracker=self.tracker,
            gicp=self.gicp,
            refinement=self.refinement,
            keyframes=self.keyframes,
            trackable=self.trackable,
            mapper=self.mapper,
            policy=self._policy(),
            covisibility=self.covisibility,
            window=self.window,
            monocular=self.mono,
            initialisation=self.initialisation,
            use_identity=self.use_identity,
            tracked_masks=self.tracked_masks,
        )

    def _policy(self) -> KeyframePolicyKind:
        if self.policy == "auto":
            return "covisibility" if self.tracker == "photometric" else "overlap"
        return self.policy

    @property
    def mask_folder(self) -> str | None:
        """What :func:`ggwarp.datasets.open_dataset` takes as ``masks``."""
        return None if self.masks == "untracked" else self.masks

    @property
    def tracked_masks(self) -> bool:
        """Whether the masks' ids mean the same object in every frame."""
        return self.masks_kind == "tracked" and self.masks != "untracked"

    def data_root(self) -> Path:
        """Return the folder that sequences are looked up in."""
        return self.data or Path(os.environ.get("GGWARP_DATA") or "data")


def preset_config(name: str) -> RunConfig:
    """Return the configuration that the preset ``name`` stands for.

    Raises:
        ConfigError: there is no such preset.
    """
    if name not in _PRESETS:
        raise ConfigError(f"--preset {name}: no such preset; choose one of {', '.join(_PRESETS)}")
    return dataclasses.replace(_PRESETS[name](RunConfig()), preset=name)  # pyright: ignore[reportArgumentType]


def _with_iterations(factor: float) -> Callable[[RunConfig], RunConfig]:
    def change(config: RunConfig) -> RunConfig:
        iterations = max(1, round(factor * config.mapper.iterations))
        return dataclasses.replace(config, mapper=dataclasses.replace(config.mapper, iterations=iterations))

    return change


def _fast(config: RunConfig) -> RunConfig:
    """Two iterations a frame on about half the Gaussians, and three quarters of the tracked points."""
    mapper = config.mapper
    return dataclasses.replace(
        config,
        gicp=dataclasses.replace(config.gicp, points=6000),
        mapper=dataclasses.replace(
            mapper,
            iterations=2,
            seeding=dataclasses.replace(mapper.seeding, min_density=0.12, max_density=0.3),
        ),
    )


def _monogs(config: RunConfig) -> RunConfig:
    """Tracking by rendering, a covisible window fitted with its poses: 150 iterations in six frames."""
    mapper = dataclasses.replace(
        config.mapper,
        iterations=25,
        bootstrap=150,
        pose_rates=(1e-3, 1e-3),
        isotropic_weight=2.0,
        rate_decay=0.0,
    )
    return dataclasses.replace(config, tracker="photometric", use_identity=False, mapper=mapper)


_PRESETS: dict[str, Callable[[RunConfig], RunConfig]] = {
    "gg-slam": lambda config: config,
    "gs-icp": lambda config: dataclasses.replace(config, use_identity=False),
    "monogs": _monogs,
    "fast": _fast,
    "quality": _with_iterations(3.0),
}


def load_config(path: Path) -> RunConfig:
    """Read a saved configuration, or any part of one; what is left out has its preset's value.

    Raises:
        ConfigError: the file is missing or not TOML, or a key is unknown or of the wrong type.
    """
    try:
        values = read_toml(path)
        return merged(preset_config(str(values.get("preset", "gg-slam"))), values, where=str(path))
    except TomlError as error:
        raise ConfigError(f"--config {error}") from None


def check(config: RunConfig) -> None:
    """Refuse what the options alone show to be wrong.

    Raises:
        ConfigError: names the option, its value and the remedy.
    """
    if not config.seq:
        raise ConfigError("--seq is missing: give a sequence's name or its folder, such as --seq office0")
    try:
        tracker_factory(config.tracker)
    except TrackerError as error:
        raise ConfigError(f"--tracker {error}") from None
    if config.tracker == "photometric" and config.policy == "overlap":
        raise ConfigError("--policy overlap: --tracker photometric keeps no points; choose covisibility")
    if config.preset not in _PRESETS:
        preset_config(config.preset)
    if config.scale is not None and not 0.0 < config.scale <= 1.0:
        raise ConfigError(f"--scale {config.scale:g}: give a number above 0 and at most 1")
    if isinstance(config.fps, float) and not 0.0 < config.fps < math.inf:
        raise ConfigError(f"--fps {config.fps:g}: give a number above 0, or uncapped")
    if config.refine < 0:
        raise ConfigError(f"--refine {config.refine}: give 0 or a positive number of iterations")
    if config.save_renders is not None and config.save_renders < 0:
        raise ConfigError(f"--save-renders {config.save_renders}: give 0 or a positive number")
    if config.data is not None and not config.data.is_dir():
        raise ConfigError(f"--data {config.data}: no such folder")
    frame_slice(config.frames)


def frame_slice(text: str | None) -> slice:
    """Return the slice that A:B:STEP means; each part may be empty.

    Raises:
        ConfigError: it is not of that form, or STEP is not positive.
    """
    if text is None:
        return slice(None)
    try:
        parts = [int(p) if p.strip() else None for p in text.split(":")]
    except ValueError:
        parts = []
    if not 2 <= len(parts) <= 3:
        raise ConfigError(f"--frames {text}: expected A:B or A:B:STEP in whole numbers, such as 0:200:2")
    if len(parts) == 3 and parts[2] is not None and parts[2] < 1:
        raise ConfigError(f"--frames {text}: STEP is {parts[2]}, but at least 1 is needed")
    return slice(*parts)


def frame_indices(text: str | None, count: int) -> range:
    """Return the frames that ``text`` picks from a sequence of ``count``.

    Raises:
        ConfigError: it picks none.
    """
    indices = range(count)[frame_slice(text)]
    if not indices:
        raise ConfigError(f"--frames {text}: no frame left; the sequence has {count}, numbered from 0")
    return indices


def device_name(wanted: str) -> str:
    """Return the device that ``wanted`` means on this machine.

    Raises:
        ConfigError: there is no such device.
    """
    import warp as wp

    cuda = [d.alias for d in wp.get_cuda_devices()]
    if wanted == "auto":
        return cuda[0] if cuda else "cpu"
    name = "cuda:0" if wanted == "cuda" else wanted
    if name not in ["cpu", *cuda]:
        raise ConfigError(f"--device {wanted}: no such device; this machine has {', '.join(['cpu', *cuda])}")
    return name


def image_scale(wanted: float | None, camera: Camera, device: str) -> float:
    """Return the image scale to use for pictures of ``camera``.

    Raises:
        ConfigError: the pictures would be too small.
    """
    if wanted is not None:
        scale = wanted
    elif device == "cpu":
        twentieths = round(20 * math.sqrt(_CPU_PIXELS / (camera.width * camera.height)))
        scale = min(max(twentieths, 1), 20) / 20
    else:
        scale = 1.0
    size = camera.scaled(scale)
    if min(size.width, size.height) < _MIN_SIDE:
        raise ConfigError(
            f"--scale {scale:g}: images of {size.width}x{size.height} are too small; "
            f"at least {_MIN_SIDE} pixels a side are needed"
        )
    return scale
