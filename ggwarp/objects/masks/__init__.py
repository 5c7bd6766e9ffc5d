# SPDX-License-Identifier: Apache-2.0
"""Masks on their way to the map's objects: association, splitting, merging, and what contradicts the map."""
