# SPDX-License-Identifier: Apache-2.0
"""Which object a Gaussian is: classification, cross-entropy, neighbour term, label fusion."""
