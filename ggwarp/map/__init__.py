# SPDX-License-Identifier: Apache-2.0
"""The Gaussians on the device and on the host, and views of them."""
