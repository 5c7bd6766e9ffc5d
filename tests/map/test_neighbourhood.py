# SPDX-License-Identifier: Apache-2.0
import numpy as np

from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import Gaussians
from ggwarp.map.neighbourhood import Neighbourhood


def batch(count: int, rng: np.random.Generator) -> Gaussians:
    shapes = [(3,), (4,), (3,), (), (3,)]
    return Gaussians(*(rng.normal(size=(count, *shape)).astype(np.float32) for shape in shapes))


def test_neighbours_are_the_nearest(device: str, rng: np.random.Generator) -> None:
    gaussians = GaussianMap(device=device, has_identity=False)
    neighbourhood = Neighbourhood(gaussians, samples=50, k=4, seed=1)
    for _ in range(2):  # the grid follows the map
        gaussians.append(batch(1200, rng))
        gaussians.fields["means"].assign(rng.normal(size=(gaussians.capacity, 3)).astype(np.float32))
        neighbourhood.sample()
        means = gaussians.to_host().means.astype(np.float64)
        samples, found = neighbourhood.samples.numpy(), neighbourhood.neighbours.numpy()
        distances = np.linalg.norm(means[samples][:, None] - means[None], axis=2)
        nearest = np.sort(distances, axis=1)[:, :4]
        np.testing.assert_allclose(np.take_along_axis(distances, found, axis=1), nearest, atol=1e-6)
        assert (found[:, 0] == samples).all()
