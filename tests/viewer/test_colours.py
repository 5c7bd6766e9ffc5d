# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ggwarp.map.gaussians import Gaussians
from ggwarp.objects.linear_classifier import LinearClassifier
from ggwarp.viewer import colours

EYE = np.zeros(3)


@pytest.fixture
def classifier() -> LinearClassifier:
    """Knows the scene's identities, which are unit vectors by id: 1 surely, 5 less so."""
    weights = np.zeros((3, 16), np.float32)
    weights[0, 1], weights[1, 5], weights[2, 8] = 9.0, 1.0, 9.0
    return LinearClassifier(weights, np.zeros(3, np.float32), np.array([1, 5, 8]))


def test_modes_are_those_that_the_map_can_show(scene, classifier):
    assert colours.modes(scene, classifier) == ["colour", "depth", "objects", "identity", "uncertainty"]
    assert colours.modes(scene, None)[-1] == "identity"
    bare = dataclasses.replace(scene, object_ids=None, identities=None)
    assert colours.modes(bare, classifier) == ["colour", "depth"]


def test_each_mode_shows_what_it_says(scene, classifier):
    shown = {
        mode: colours.splat_colours(scene, mode, eye=EYE, classifier=classifier)
        for mode in colours.modes(scene, classifier)
    }
    for mode, values in shown.items():
        assert values.shape == (len(scene), 3) and values.dtype == np.float32, mode
        assert values.min() >= 0.0 and values.max() <= 1.0, mode
    red, wall = scene.object_ids == 5, scene.object_ids == 1
    np.testing.assert_allclose(shown["colour"][red], np.tile([0.9, 0.1, 0.1], (red.sum(), 1)), atol=1e-3)
    nearest = np.linalg.norm(scene.means, axis=1).argmin()
    assert shown["depth"][nearest].argmax() == 0  # red
    for mode in ("objects", "identity"):
        own = np.unique(shown[mode][red], axis=0)
        assert len(own) == 1 and np.abs(own - shown[mode][wall]).max(axis=1).min() > 0.2, mode
    assert (
        shown["uncertainty"][red].mean(0).argmax() != 2 and shown["uncertainty"][wall].mean(0).argmax() == 2
    )


def test_confidence_is_the_largest_probability(scene, classifier):
    every = np.stack([classifier.probabilities(scene.identities, int(i)) for i in classifier.ids])
    np.testing.assert_allclose(classifier.confidence(scene.identities), every.max(0), rtol=1e-5)


def test_neighbouring_ids_look_different():
    shades = colours.palette(np.arange(1, 60))
    apart = np.abs(shades[1:] - shades[:-1]).max(axis=1)
    assert apart.min() > 0.25
    np.testing.assert_array_equal(colours.palette(np.array([0])), np.float32([[0.35] * 3]))


def test_maps_of_next_to_nothing(scene: Gaussians):
    for count in (0, 1):
        few = scene.take(np.arange(count))
        for mode in colours.modes(few, None):
            assert colours.splat_colours(few, mode, eye=EYE).shape == (count, 3)
