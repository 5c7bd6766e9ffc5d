# SPDX-License-Identifier: Apache-2.0
"""What ``tools/benchmark.py`` is made of: a file a subcommand, and what they share."""
