# SPDX-License-Identifier: Apache-2.0
"""Measures of a run: trajectory, pictures, objects."""
