# SPDX-License-Identifier: Apache-2.0
"""The map follows its keyframes where a loop is closed."""

import dataclasses

import numpy as np

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.geometry import se3
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.pipeline.mapping.build import build_mapper
from ggwarp.pipeline.mapping.mapper import Mapper, MapperConfig

OFFICE = SyntheticOffice(scale=0.1)


def made(device: str) -> Mapper:
    return build_mapper(MapperConfig(), OFFICE.camera, device=device, use_identity=True)


def test_the_map_follows_its_keyframes(device: str) -> None:
    mapper, frame = made(device), OFFICE[0]
    assert frame.T_wc is not None
    later = dataclasses.replace(OFFICE[40], index=40)
    assert later.T_wc is not None
    far_away = se3.se3_exp([50.0, 0, 0, 0, 0, 0]) @ later.T_wc
    mapper.insert(frame, frame.T_wc)
    mapper.insert(later, far_away)
    for _ in range(20):
        mapper.iterate()
    before = [mapper.render(T) for T in (frame.T_wc, far_away)]
    ids = mapper.map.fields["identities"].numpy()
    motion = se3.se3_exp([-1.0, 0.5, 0.2, 0.3, -0.2, 0.9])

    mapper.move(PoseCorrection((0, 40), np.stack([np.eye(4), motion])))

    poses = mapper.keyframe_pose(0), mapper.keyframe_pose(1)
    np.testing.assert_allclose(poses[0], frame.T_wc, atol=1e-6)
    np.testing.assert_allclose(poses[1], motion @ far_away, atol=2e-5)
    np.testing.assert_array_equal(mapper.map.fields["identities"].numpy(), ids)
    for view, pose in zip(before, poses, strict=True):
        again = mapper.render(pose)
        assert np.abs(again.rgb - view.rgb).mean() < 1e-4
        assert np.abs(again.depth - view.depth).mean() < 1e-4
    assert np.isfinite((mapper.iterate(), mapper.synchronise())[1])


def test_an_empty_map_moves(device: str) -> None:
    mapper = made(device)
    mapper.move(PoseCorrection((0,), np.eye(4)[None]))
    assert not mapper.ready
