# SPDX-License-Identifier: Apache-2.0
"""Object-level RGB-D Gaussian-splatting SLAM on NVIDIA Warp kernels."""

__version__ = "0.1.0"
