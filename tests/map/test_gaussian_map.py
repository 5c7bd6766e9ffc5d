# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import warp as wp

from ggwarp.map.gaussian_map import PARAMETERS, GaussianMap
from ggwarp.map.gaussians import Gaussians


def batch(count: int, rng: np.random.Generator, *, identity: bool = True) -> Gaussians:
    def draw(*shape: int) -> np.ndarray:
        return rng.normal(size=(count, *shape)).astype(np.float32)

    return Gaussians(draw(3), draw(4), draw(3), draw(), draw(3), identities=draw(16) if identity else None)


def test_rows_stay_what_they_were_while_the_map_grows(device: str, rng: np.random.Generator) -> None:
    gaussians = GaussianMap(device=device, has_identity=True, capacity=4)
    first, second = batch(3, rng), batch(40, rng)

    gaussians.append(first)
    gaussians.append(second)

    host = gaussians.to_host()
    assert gaussians.count == 43 and gaussians.capacity >= 43
    for name in PARAMETERS:
        assert (getattr(host, name) == np.concatenate([getattr(first, name), getattr(second, name)])).all()


def test_new_rows_have_no_history(device: str, rng: np.random.Generator) -> None:
    gaussians = GaussianMap(device=device, has_identity=False, capacity=8)
    gaussians.append(batch(4, rng, identity=False))
    gaussians.fields["steps"].fill_(7)
    gaussians.keep(wp.array([1, 1, 0, 0], dtype=int, device=device))
    gaussians.append(batch(2, rng, identity=False))
    assert gaussians.fields["steps"].numpy()[:4].tolist() == [7, 7, 0, 0]


def test_keep_drops_rows_and_moments_together(device: str, rng: np.random.Generator) -> None:
    gaussians = GaussianMap(device=device, has_identity=True, capacity=8)
    rows = batch(5, rng)
    gaussians.append(rows)
    gaussians.fields["steps"].assign(np.arange(8, dtype=np.int32))
    before = gaussians.version

    dropped = gaussians.keep(wp.array([1, 0, 0, 1, 1], dtype=int, device=device))

    assert dropped == 2 and gaussians.count == 3 and gaussians.version > before
    assert (gaussians.to_host().means == rows.means[[0, 3, 4]]).all()
    assert gaussians.fields["steps"].numpy()[:3].tolist() == [0, 3, 4]


@pytest.mark.parametrize("flags", [[0, 0, 0], [1, 1, 1]])
def test_keeping_none_or_all(flags: list[int], device: str, rng: np.random.Generator) -> None:
    gaussians = GaussianMap(device=device, has_identity=False)
    gaussians.append(batch(3, rng, identity=False))
    gaussians.keep(wp.array(flags, dtype=int, device=device))
    assert gaussians.count == sum(flags)


def test_an_empty_batch_changes_nothing(device: str, rng: np.random.Generator) -> None:
    gaussians = GaussianMap(device=device, has_identity=False)
    gaussians.append(batch(0, rng, identity=False))
    assert gaussians.count == gaussians.version == 0


def test_identities_must_come_where_the_map_has_them(device: str, rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match="identities"):
        GaussianMap(device=device, has_identity=True).append(batch(2, rng, identity=False))
