# SPDX-License-Identifier: Apache-2.0
"""Gaussians to pixels and back: projection, tile binning, alpha compositing, and the adjoints."""
