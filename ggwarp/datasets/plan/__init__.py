# SPDX-License-Identifier: Apache-2.0
"""What a sequence is taken for, and whether that can be right: told before work starts."""
