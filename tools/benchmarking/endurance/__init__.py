# SPDX-License-Identifier: Apache-2.0
"""What long runs cost: a path that goes on and on, and what grows on it."""
