# SPDX-License-Identifier: Apache-2.0
"""How kernels are run: launches, streams, recorded graphs, loading; nothing here computes."""
