# SPDX-License-Identifier: Apache-2.0
"""The kernels as torch functions, differentiable where that makes sense."""
