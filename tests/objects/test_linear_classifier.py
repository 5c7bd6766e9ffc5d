# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.special import softmax

from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import Gaussians
from ggwarp.objects.classifier import Classifier, ClassifierConfig, random_identities
from ggwarp.objects.linear_classifier import LinearClassifier, read_classifier, write_classifier


def test_probabilities_are_the_classifiers_own(device, rng, tmp_path):
    """The saved classifier must choose the Gaussians that the run did."""
    n = 200
    gaussians = GaussianMap(device=device, has_identity=True)
    zeros = np.zeros((n, 3), np.float32)
    identities = random_identities(n, rng)
    gaussians.append(
        Gaussians(zeros, np.ones((n, 4), np.float32), zeros, zeros[:, 0], zeros, identities=identities)
    )
    classifier = Classifier(ClassifierConfig(), gaussians, seed=1)
    classifier.grow(6)
    labels, probabilities = classifier.classify_map()

    ids = np.array([0, 7, 8, 300, 5, 2])
    write_classifier(tmp_path / "c.npz", LinearClassifier(*classifier.to_host(), ids))
    saved = read_classifier(tmp_path / "c.npz")
    own = np.stack([saved.probabilities(identities, i) for i in ids], axis=1)
    np.testing.assert_allclose(own.sum(1), 1.0, atol=1e-5)
    np.testing.assert_array_equal(own.argmax(1), labels)
    np.testing.assert_allclose(own.max(1), probabilities, atol=1e-4)
    expected = softmax(identities.astype(float) @ saved.weights.T + saved.biases, axis=1)
    np.testing.assert_allclose(own, expected, atol=1e-5)
    assert not saved.probabilities(identities, 99).any()


def test_a_file_that_is_no_classifier(tmp_path):
    path = tmp_path / "c.npz"
    path.write_text("hello")
    with pytest.raises(ValueError, match=r"c\.npz: is no identity classifier"):
        read_classifier(path)
    np.savez(path, weights=np.zeros((3, 16)), biases=np.zeros(3), ids=np.zeros(2))
    with pytest.raises(ValueError, match="do not fit"):
        read_classifier(path)
