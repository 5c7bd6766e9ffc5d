# SPDX-License-Identifier: Apache-2.0
"""The camera's side: a pose for each frame, and which frames become keyframes; never writes the map."""
