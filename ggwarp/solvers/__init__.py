# SPDX-License-Identifier: Apache-2.0
"""Registration (GICP) and direct alignment of Warp arrays: loops over kernels, no torch."""
