# SPDX-License-Identifier: Apache-2.0
"""What can be told of the kernels' CUDA binaries without a GPU."""
