# SPDX-License-Identifier: Apache-2.0
"""What ``tools/benchmark.py`` is made of: a file a subcommand, and what they share."""

import os

# OpenMP's threads would spin for a while after each of a peer's calls, on a core that our next one is timed
# on. Read when the first OpenMP library is loaded: torch's, mostly.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
