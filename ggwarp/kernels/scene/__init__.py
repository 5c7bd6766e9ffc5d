# SPDX-License-Identifier: Apache-2.0
"""Ray-casting of the built-in scenes: primitives, textures, light."""
