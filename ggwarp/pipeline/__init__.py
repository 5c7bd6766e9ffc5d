# SPDX-License-Identifier: Apache-2.0
"""The SLAM system: what schedules tracking and mapping, and the parts of either."""
