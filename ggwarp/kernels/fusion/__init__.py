# SPDX-License-Identifier: Apache-2.0
"""Depth images fused into a volume."""
