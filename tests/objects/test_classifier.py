# SPDX-License-Identifier: Apache-2.0
import numpy as np
import warp as wp

from ggwarp.geometry.camera import Camera
from ggwarp.kernels.losses.rgbd import LOSS_COUNT, OBJECT, OBJECT_3D
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import Gaussians
from ggwarp.map.renderer import Renderer
from ggwarp.objects.classifier import Classifier, ClassifierConfig

CAMERA = Camera(48, 32, 40.0, 40.0, 23.5, 15.5)


def wall(identities: np.ndarray, rng: np.random.Generator) -> Gaussians:
    """Opaque Gaussians on the plane z = 1; left half: identities[0], right half: identities[1]."""
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 40), np.linspace(-0.5, 0.5, 30))
    n = x.size
    means = np.stack([x.ravel(), y.ravel(), np.ones(n)], axis=1).astype(np.float32)
    side = (means[:, 0] > 0).astype(int)
    return Gaussians(
        means,
        np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        np.full((n, 3), np.log(0.02), np.float32),
        np.full(n, 3.0, np.float32),
        rng.normal(size=(n, 3)).astype(np.float32),
        identities=identities[side].astype(np.float32),
    )


def made(device: str, config: ClassifierConfig, **options) -> tuple[GaussianMap, Renderer, Classifier]:
    gaussians = GaussianMap(device=device, has_identity=True)
    return gaussians, Renderer(gaussians, CAMERA), Classifier(config, gaussians, seed=3, **options)


def test_gaussians_with_their_class_s_code_are_classified_at_once(
    device: str, rng: np.random.Generator
) -> None:
    gaussians, renderer, classifier = made(device, ClassifierConfig())
    classifier.grow(40)
    gaussians.append(wall(classifier.codes[[7, 31]], rng))

    labels, probabilities = classifier.classify_map()
    renderer.forward(renderer.pose_array(np.eye(4)))
    picture, probability = classifier.classify_image(renderer.image, CAMERA.height, CAMERA.width)

    side = gaussians.to_host().means[:, 0] > 0
    assert (labels == np.where(side, 31, 7)).all() and (probabilities > 0.9).all()
    assert (picture[:, 2:22] == 7).all() and (picture[:, 26:-2] == 31).all()
    assert (probability[:, 2:22] > 0.9).all() and probability.max() <= 1.0


def test_random_identities_are_trained(device: str, rng: np.random.Generator) -> None:
    config = ClassifierConfig(sample_stride=2, rate=0.05)
    gaussians, renderer, classifier = made(device, config)
    classifier.grow(3)
    gaussians.append(wall(rng.normal(size=(2, 16)), rng))
    labels = np.ones((CAMERA.height, CAMERA.width), np.int32)
    labels[:, CAMERA.width // 2 :] = 2
    on_device = wp.array(labels, dtype=int, device=device)
    losses = wp.zeros(LOSS_COUNT, dtype=float, device=device)
    pose = renderer.pose_array(np.eye(4))
    history = []
    for i in range(60):
        renderer.forward(pose, sample=classifier.draw_sample(on_device))
        classifier.evaluate(renderer, on_device, losses)
        renderer.adjoint(pose)
        if classifier.begin_3d(i):
            classifier.evaluate_3d(renderer, losses)
        classifier.step()
        history.append(losses.numpy()[OBJECT])
    assert history[-1] < 0.1 * history[0]
    picture, _ = classifier.classify_image(renderer.image, CAMERA.height, CAMERA.width)
    assert (picture[:, 2:22] == 1).all() and (picture[:, 26:-2] == 2).all()
    assert np.isfinite(losses.numpy()[OBJECT_3D])


def test_classes_grow_past_their_room_and_keep_what_they_learnt(device: str) -> None:
    _, _, classifier = made(device, ClassifierConfig(), capacity=4)
    classifier.grow(3)
    before = classifier.codes.copy()
    weights = classifier._weights.numpy()[:3].copy()
    classifier.grow(300)
    assert classifier.count == 300
    assert (classifier.codes[:3] == before).all()
    assert (classifier._weights.numpy()[:3] == weights).all()
    assert (classifier._weights.numpy()[3:300] == classifier.codes[3:]).all()


def test_a_view_without_labels_trains_nothing(device: str, rng: np.random.Generator) -> None:
    gaussians, renderer, classifier = made(device, ClassifierConfig())
    classifier.grow(3)
    gaussians.append(wall(classifier.codes[[1, 2]], rng))
    weights = classifier._weights.numpy().copy()
    pose = renderer.pose_array(np.eye(4))
    renderer.forward(pose, sample=classifier.draw_sample(None))
    renderer.d_image[4:].fill_(1.0)
    classifier.evaluate(renderer, None, wp.zeros(LOSS_COUNT, dtype=float, device=device))
    renderer.adjoint(pose)
    classifier.step()
    assert not renderer.gradients.identities.numpy().any()
    assert (classifier._weights.numpy() == weights).all()
