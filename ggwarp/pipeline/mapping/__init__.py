# SPDX-License-Identifier: Apache-2.0
"""The map's side and only writer: keyframes enter, and Gaussians are fitted to them."""
