# SPDX-License-Identifier: Apache-2.0
"""Where a keyframe adds Gaussians, how many, and what they begin as."""
