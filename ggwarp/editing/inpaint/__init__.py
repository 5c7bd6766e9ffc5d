# SPDX-License-Identifier: Apache-2.0
"""Filling the holes that removed objects leave."""
