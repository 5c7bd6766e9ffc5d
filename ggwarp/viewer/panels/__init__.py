# SPDX-License-Identifier: Apache-2.0
"""The tabs of the page: each shows a part of what the page knows, and asks for work by its buttons."""
