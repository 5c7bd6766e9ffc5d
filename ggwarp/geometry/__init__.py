# SPDX-License-Identifier: Apache-2.0
"""Rigid motions, cameras, two-view geometry, boxes and voxels; NumPy on the host."""
