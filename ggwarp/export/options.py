# SPDX-License-Identifier: Apache-2.0
"""What a user may choose about an export."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ExportOptions:
    """How files are written.

    Attributes:
        device: to render on; None: CUDA if there is one.
        sh_degree: of the spherical harmonics in PLY files; those above 0 are zeros.
        voxel: side of a mesh's voxels, metres; None: by the size of the map.
        every: every so many frames in folders of frames, and in meshes.
        rendered: whether folders of frames hold the map's pictures, not the recording's.
    """

    device: str | None = None
    sh_degree: int = 0
    voxel: float | None = None
    every: int = 1
    rendered: bool = False
