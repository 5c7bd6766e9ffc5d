# SPDX-License-Identifier: Apache-2.0
"""Pictures to renders: direct alignment, image pyramids, exposure."""
