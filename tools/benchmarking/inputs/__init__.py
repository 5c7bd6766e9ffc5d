# SPDX-License-Identifier: Apache-2.0
"""What is measured on: Gaussians before a camera, frames as point clouds."""
