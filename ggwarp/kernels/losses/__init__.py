# SPDX-License-Identifier: Apache-2.0
"""What rendered images are fitted by: colour, SSIM and depth losses, and their gradients."""
