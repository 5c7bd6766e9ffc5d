# SPDX-License-Identifier: Apache-2.0
"""Frames that come once: from standard input, a webcam, a RealSense camera, a phone."""
