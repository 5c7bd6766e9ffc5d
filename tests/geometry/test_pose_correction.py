# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.geometry import se3
from ggwarp.geometry.pose_correction import PoseCorrection

MOTIONS = np.stack([np.eye(4), se3.se3_exp([0.2, 0, 0, 0, 0, 0.4])])
CORRECTION = PoseCorrection((10, 20), MOTIONS)


def test_known_frames_and_those_outside_have_a_known_motion():
    found = CORRECTION.at([20, 3, 10, 99])
    np.testing.assert_array_equal(found, MOTIONS[[1, 0, 0, 1]])


def test_between_them_the_motion_is_interpolated():
    quarter = CORRECTION.at([12, 15])
    np.testing.assert_allclose(se3.se3_log(quarter[0]), [0.04, 0, 0, 0, 0, 0.08], atol=1e-12)
    np.testing.assert_allclose(quarter[1] @ quarter[1], MOTIONS[1], atol=1e-12)


def test_a_pose_keeps_its_place_beside_its_keyframe():
    keyframe, frame = se3.se3_exp([1, 2, 3, 0.1, 0.2, 0.3]), se3.se3_exp([1, 2, 3.1, 0.2, 0.2, 0.3])
    motion = CORRECTION.at([20, 25])
    np.testing.assert_allclose(
        se3.inverse(motion[0] @ keyframe) @ (motion[1] @ frame), se3.inverse(keyframe) @ frame, atol=1e-12
    )


@pytest.mark.parametrize(("indices", "count"), [((), 0), ((1, 2), 1), ((2, 1), 2), ((1, 1), 2)])
def test_what_is_no_function_of_the_frame_is_refused(indices, count):
    with pytest.raises(ValueError, match="frames"):
        PoseCorrection(indices, np.tile(np.eye(4), (count, 1, 1)))
