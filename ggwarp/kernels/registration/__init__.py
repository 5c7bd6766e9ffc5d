# SPDX-License-Identifier: Apache-2.0
"""Points to points: back-projection, neighbour search, covariances, GICP residuals and Jacobians."""
