# SPDX-License-Identifier: Apache-2.0
"""How kernels are run and arrays held: launches, streams, graphs, loading, a budget; nothing computes."""
