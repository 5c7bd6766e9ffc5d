# SPDX-License-Identifier: Apache-2.0
"""Files in and out: PLY, TOML, JSON, CSV, trajectories; whole or not at all."""
