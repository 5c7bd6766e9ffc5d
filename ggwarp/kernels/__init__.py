# SPDX-License-Identifier: Apache-2.0
"""Warp kernels and their launch functions, a subject a folder; no torch, no allocation, no waiting."""
