# SPDX-License-Identifier: Apache-2.0
"""Slow float64 oracles of the kernels, one file a topic: torch where they are differentiated, else NumPy."""
