# SPDX-License-Identifier: Apache-2.0
"""Steps of the optimiser: Adam on Gaussians, poses and the classifier; which Gaussians stay."""
