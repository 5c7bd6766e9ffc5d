# SPDX-License-Identifier: Apache-2.0
"""Recognising places again: keyframes' features, verified loops, the pose graph that closes them."""
