# SPDX-License-Identifier: Apache-2.0
"""Learning which Gaussian belongs to which object, from masks that may be wrong."""
