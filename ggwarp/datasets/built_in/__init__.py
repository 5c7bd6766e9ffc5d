# SPDX-License-Identifier: Apache-2.0
"""The built-in scenes, ray-cast with exact truth, and the faults of real sensors and masks."""
