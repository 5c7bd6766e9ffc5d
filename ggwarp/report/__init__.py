# SPDX-License-Identifier: Apache-2.0
"""A run as one page: ``report.html`` in its folder, and several runs compared. Standard library and NumPy."""
