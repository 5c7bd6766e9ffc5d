# SPDX-License-Identifier: Apache-2.0
"""The identity classifier z = W e + b and its training (GG-SLAM eqs. 8-10)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.kernels.identity.classify import classify_gaussians, classify_pixels
from ggwarp.kernels.identity.cross_entropy import cross_entropy
from ggwarp.kernels.identity.neighbour_kl import neighbour_divergence
from ggwarp.kernels.identity.random import draw_sample
from ggwarp.kernels.losses.rgbd import OBJECT
from ggwarp.kernels.math import vec16
from ggwarp.kernels.optim.adam import adam_classifier
from ggwarp.kernels.raster.sampling import Sample
from ggwarp.kernels.workspaces import allocate_identity, allocate_neighbours
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import SH_C0
from ggwarp.map.neighbourhood import Neighbourhood
from ggwarp.map.renderer import Renderer
from ggwarp.runtime.state import FrameSource, State, Stateful
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float32

IDENTITY_SIZE = 16

_CLASSES = 100  # room for so many at first; it grows with the ids
_INTERVAL_3D = 5  # the 3-D term is evaluated at every N-th iteration
_SAMPLES_3D = 1000  # Gaussians sampled for the 3-D term
_NEIGHBOURS_3D = 5  # nearest neighbours compared with each sample


@dataclass(frozen=True)
class ClassifierConfig:
    """How identities are learnt."""

    weight: float = 0.1
    """Weight of the cross-entropy in the loss (GG-SLAM eq. 5: l_obj)."""
    weight_3d: float = 0.0
    """Weight of the 3-D neighbour term (l_obj3d): 1 as published; no better where keyframes vote."""
    rate: float = 5e-4
    """Adam's learning rate of the classifier."""
    shapes: bool = True
    """The cross-entropy's gradient also moves, shapes and fades Gaussians, as published; False: identities
    learn and leave the picture as it is without them."""
    sample_stride: int = 4
    """Identities are rendered and compared on every N-th tile of 16 x 16 pixels, drawn for each iteration:
    most of what identities cost goes with their number."""


@dataclass(frozen=True)
class IdentitySeeds:
    """What the Gaussians that a frame adds begin as.

    Attributes:
        codes: [classes, 16] the identity that each class starts from.
        classes: [h, w] int, on the device, the class of the Gaussians that begin at each pixel; negative, or
            None: not known.
        votes: [h, w] int, on the device, the class that each pixel votes for; negative, or None: none.
    """

    codes: Float32
    classes: Any = None
    votes: Any = None


def random_identities(count: int, rng: np.random.Generator) -> Float32:
    """Return [count, 16] random identities (GG-SLAM eq. 2)."""
    return ((rng.random((count, IDENTITY_SIZE)) - 0.5) / SH_C0).astype(np.float32)


class Classifier(Stateful):
    """W [classes, 16] and b [classes], their Adam state, and the losses that train them.

    A class starts as the nearest-code rule: W_c = code_c and b_c = -|code_c|^2 / 2, where ``codes``
    [classes, 16] are random identities. Gaussians seeded with their object's code are then classified
    rightly from the start, and training refines what seeding got wrong.
    """

    STATE = (
        "codes",
        "_draws",
        "_neighbourhood",
        "_weights",
        "_biases",
        "_weight_moments",
        "_bias_moments",
        "_steps",
    )

    def __init__(
        self, config: ClassifierConfig, gaussians: GaussianMap, *, seed: int, capacity: int = _CLASSES
    ) -> None:
        """Prepare to classify ``gaussians``, of no object so far.

        Args:
            seed: of the random codes, and of where losses are sampled.
            capacity: room for so many classes at first.
        """
        self._config = config
        self._map = gaussians
        self._device = gaussians.device
        self._seed = seed
        self.codes = np.zeros((0, IDENTITY_SIZE), np.float32)
        self._rate = wp.array([config.rate], dtype=float, device=self._device)
        self._draws, phase = (wp.zeros(1, dtype=int, device=self._device) for _ in range(2))
        self._sample = Sample(config.sample_stride, phase)
        self._neighbourhood = Neighbourhood(gaussians, samples=_SAMPLES_3D, k=_NEIGHBOURS_3D + 1, seed=seed)
        self._image_workspace: Any = None
        self._allocate(capacity)
        self.grow(1)

    def restore(self, state: State, frames: FrameSource) -> None:
        """Take over the classes, with the room that there was for more."""
        self._allocate(len(state["_steps"]))
        self._image_workspace = None
        super().restore(state, frames)

    @property
    def count(self) -> int:
        """Classes in use, "no object" included."""
        return len(self.codes)

    def grow(self, count: int) -> None:
        """Add classes up to ``count``."""
        if count <= self.count:
            return
        if count > self._capacity:
            self._enlarge(max(count, 2 * self._capacity))
        begin = self.count
        new = random_identities(count - begin, np.random.default_rng((self._seed, 2, begin)))
        self.codes = np.concatenate([self.codes, new])
        self._weights[begin:count].assign(new)
        self._biases[begin:count].assign(-0.5 * (new**2).sum(axis=1))

    def draw_sample(self, labels: wp.array | None) -> Sample:
        """Draw where the next view's identities are rendered and compared; nowhere without ``labels``."""
        none = labels is None or self.count < 2
        draw_sample(self._sample, seed=self._seed, draws=self._draws, none=none, device=self._device)
        return self._sample

    def evaluate(self, renderer: Renderer, labels: wp.array | None, losses: wp.array) -> None:
        """Write the identity part of ``renderer.d_image`` and of ``losses``.

        Args:
            renderer: after its forward pass with the sample drawn for ``labels``.
            labels: [h, w] class of each pixel; None: this view says nothing of objects.
            losses: see :data:`ggwarp.kernels.losses.rgbd.LOSS_COUNT`.
        """
        if labels is None or self.count < 2:
            self._d_weights.zero_()
            self._d_biases.zero_()
            losses[OBJECT : OBJECT + 1].zero_()
            return
        if self._image_workspace is None:
            _, height, width = renderer.image.shape
            self._image_workspace = allocate_identity(
                height, width, capacity=self._capacity, device=self._device
            )
        cross_entropy(
            renderer.image,
            labels,
            weights=self._weights,
            biases=self._biases,
            classes=self.count,
            d_image=renderer.d_image,
            d_weights=self._d_weights,
            d_biases=self._d_biases,
            losses=losses,
            workspace=self._image_workspace,
            sample=self._sample,
            weight=self._config.weight,
            device=self._device,
        )

    def begin_3d(self, iteration: int) -> bool:
        """Return whether the 3-D term is due; sample its Gaussians then. Reads a map that has changed."""
        due = self.count > 1 and self._config.weight_3d != 0.0 and iteration % _INTERVAL_3D == 0
        if due:
            self.sample_3d()
        return due

    def sample_3d(self) -> None:
        """Sample the Gaussians of the 3-D term."""
        self._neighbourhood.sample()

    def evaluate_3d(self, renderer: Renderer, losses: wp.array) -> None:
        """Add the 3-D term of the Gaussians sampled to the gradients; after the renderer's adjoint."""
        neighbour_divergence(
            self._map.fields["identities"],
            samples=self._neighbourhood.samples,
            neighbours=self._neighbourhood.neighbours,
            ranks=renderer.ranks,
            weights=self._weights,
            biases=self._biases,
            classes=self.count,
            d_identities=renderer.gradients.identities,
            d_weights=self._d_weights,
            d_biases=self._d_biases,
            losses=losses,
            workspace=self._workspace_3d,
            # Each sample is its own first neighbour, at no divergence.
            weight=self._config.weight_3d * (_NEIGHBOURS_3D + 1) / _NEIGHBOURS_3D,
            device=self._device,
        )

    def step(self) -> None:
        """Take one Adam step."""
        adam_classifier(
            self._weights,
            self._biases,
            d_weights=self._d_weights,
            d_biases=self._d_biases,
            weight_moments=self._weight_moments,
            bias_moments=self._bias_moments,
            steps=self._steps,
            rate=self._rate,
            classes=self.count,
            device=self._device,
        )

    def classify_image(self, image: wp.array, height: int, width: int) -> tuple[NDArray[np.int32], Float32]:
        """Return the likeliest class of each pixel of a render [20, Hp, Wp], and its probability."""
        return _on_host(self.classify_on_device(image, height, width))

    def classify_on_device(self, image: wp.array, height: int, width: int) -> tuple[Any, Any]:
        """As :meth:`classify_image`, but [h, w] int and float stay on the device."""
        return self._classified(classify_pixels, image, height, width)

    def classify_map(self, part: GaussianMap | None = None) -> tuple[NDArray[np.int32], Float32]:
        """Return [n] the likeliest class of each Gaussian and [n] its probability.

        Args:
            part: another part of the map than is being fitted.
        """
        gaussians = self._map if part is None else part
        n = gaussians.count
        return _on_host(self._classified(classify_gaussians, gaussians.fields["identities"][:n], n))

    def _classified(self, classify: Callable[..., None], identities: Any, *shape: int) -> tuple[Any, Any]:
        labels = wp.empty(shape, dtype=int, device=self._device)
        probabilities = wp.empty(shape, dtype=float, device=self._device)
        classify(
            identities,
            weights=self._weights,
            biases=self._biases,
            classes=self.count,
            labels=labels,
            probabilities=probabilities,
            device=self._device,
        )
        return labels, probabilities

    def to_host(self) -> tuple[Float32, Float32]:
        """Return copies of W [count, 16] and b [count]."""
        n = self.count
        return to_host(self._weights)[:n].copy(), to_host(self._biases)[:n].copy()

    def _allocate(self, capacity: int) -> None:
        def zeros(shape: Any, dtype: Any) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=self._device)

        self._capacity = capacity
        self._weights, self._d_weights = zeros(capacity, vec16), zeros(capacity, vec16)
        self._biases, self._d_biases = zeros(capacity, float), zeros(capacity, float)
        self._weight_moments, self._bias_moments = zeros((2, capacity), vec16), zeros((2, capacity), float)
        self._steps = zeros(capacity, wp.int32)
        self._workspace_3d = allocate_neighbours(
            _SAMPLES_3D, _NEIGHBOURS_3D + 1, capacity=capacity, device=self._device
        )

    def _enlarge(self, capacity: int) -> None:
        names = ("_weights", "_biases", "_weight_moments", "_bias_moments", "_steps")
        old = {name: to_host(getattr(self, name)).copy() for name in names}
        self._allocate(capacity)
        self._image_workspace = None
        for name, values in old.items():
            array = getattr(self, name)
            grown = to_host(array).copy()
            grown[tuple(slice(s) for s in values.shape)] = values
            array.assign(grown)


def _on_host(classified: tuple[Any, Any]) -> tuple[NDArray[np.int32], Float32]:
    labels, probabilities = classified
    return np.asarray(to_host(labels), np.int32), np.asarray(to_host(probabilities), np.float32)
