# SPDX-License-Identifier: Apache-2.0
"""Labels of a view fused into the Gaussians that it shows: each identity as a running mean of codes.

A Gaussian is shown where its mean projects to, if the view's depth there is its own. Every label seen there
is a vote: the identity becomes the mean of the codes of its votes, so that the nearest code is that of the
majority, whatever the order in which they came.
"""

from typing import Any

import warp as wp

from ggwarp.kernels.camera import CameraIntrinsics
from ggwarp.kernels.math import transform_point, vec16
from ggwarp.kernels.raster.project import NEAR
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})


@wp.func
def _shown_at(
    mean: wp.vec3,
    T_cw: wp.mat44,
    camera: CameraIntrinsics,
    tolerance: float,
    depth: wp.array2d[wp.float32],
) -> wp.vec2i:
    """Return (row, column) of the pixel that shows a point; (-1, -1) where none does."""
    p = transform_point(T_cw, mean)
    pixel = wp.vec2i(-1, -1)
    # False for NaN.
    if p[2] > NEAR:
        u = camera.fx * p[0] / p[2] + camera.cx
        v = camera.fy * p[1] / p[2] + camera.cy
        inside = u > -0.5 and v > -0.5 and u < float(camera.width) - 0.5 and v < float(camera.height) - 0.5
        if inside:
            column = wp.clamp(int(wp.floor(u + 0.5)), 0, camera.width - 1)
            row = wp.clamp(int(wp.floor(v + 0.5)), 0, camera.height - 1)
            d = depth[row, column]
            if d > 0.0 and wp.abs(p[2] - d) <= tolerance * d:
                pixel = wp.vec2i(row, column)
    return pixel


@wp.kernel
def _evidence_kernel(
    means: wp.array[wp.vec3],
    votes: wp.array[wp.int32],
    T_cw: wp.array[wp.mat44],
    camera: CameraIntrinsics,
    tolerance: float,
    depth: wp.array2d[wp.float32],
    evidence: wp.array2d[wp.int32],
):
    i = wp.tid()
    if votes[i] > 0:
        at = _shown_at(means[i], T_cw[0], camera, tolerance, depth)
        if at[0] >= 0:
            wp.atomic_max(evidence, at[0], at[1], votes[i])


@wp.kernel
def _fuse_kernel(
    offset: int,
    means: wp.array[wp.vec3],
    T_cw: wp.array[wp.mat44],
    camera: CameraIntrinsics,
    tolerance: float,
    depth: wp.array2d[wp.float32],
    labels: wp.array2d[wp.int32],
    codes: wp.array[vec16],
    limits: wp.array[wp.int32],
    identities: wp.array[vec16],
    votes: wp.array[wp.int32],
):
    i = offset + wp.tid()
    at = _shown_at(means[i], T_cw[0], camera, tolerance, depth)
    if at[0] < 0:
        return
    label = labels[at[0], at[1]]
    if label < 0 or label >= codes.shape[0]:
        return
    n = wp.min(votes[i], wp.max(limits[label], 1) - 1)
    identities[i] += (codes[label] - identities[i]) / float(n + 1)
    votes[i] = n + 1


def gather_evidence(
    means: Any,
    votes: Any,
    *,
    count: int,
    T_cw: Any,
    camera: CameraIntrinsics,
    depth: Any,
    tolerance: float,
    evidence: Any,
    device: Any,
) -> None:
    """Write how many votes stand behind what the map says at each pixel: the most of any Gaussian there.

    Args:
        means: [>= count] vec3, world frame, metres.
        votes: [>= count] int, votes of each Gaussian.
        T_cw: [1] mat44, world to camera.
        depth: [h, w] float, the view's depth, metres; 0 = none.
        tolerance: a Gaussian is shown where its depth is within this share of the view's.
        evidence: [h, w] int, written; 0 where no Gaussian's centre is shown.
        device: a Warp device.
    """
    evidence.zero_()
    # Not split over threads: on the CPU an atomic maximum is no more than a comparison.
    wp.launch(
        _evidence_kernel,
        dim=count,
        inputs=[means, votes, T_cw, camera, tolerance, depth],
        outputs=[evidence],
        device=device,
    )


def fuse_labels(
    means: Any,
    *,
    count: int,
    T_cw: Any,
    camera: CameraIntrinsics,
    depth: Any,
    labels: Any,
    codes: Any,
    limits: Any,
    tolerance: float,
    identities: Any,
    votes: Any,
    device: Any,
) -> None:
    """Count a view's labels as votes of the Gaussians that it shows.

    e <- e + (code - e) / (n + 1), n <- n + 1 for a Gaussian with n votes, at most the class's limit less
    one: in the long run the mean forgets, so that it can be won over.

    Args:
        means, count, T_cw, camera, depth, tolerance: as of :func:`gather_evidence`.
        labels: [h, w] int class of each pixel; no vote outside [0, classes).
        codes: [classes] vec16, each class's code.
        limits: [classes] int, votes that count, this one included; at least 1.
        identities: [>= count] vec16, updated.
        votes: [>= count] int, updated.
        device: a Warp device.
    """
    launch_split(
        _fuse_kernel,
        count,
        inputs=[means, T_cw, camera, tolerance, depth, labels, codes, limits],
        outputs=[identities, votes],
        device=device,
    )
