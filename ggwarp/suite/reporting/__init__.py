# SPDX-License-Identifier: Apache-2.0
"""A suite's results for people: the papers' tables, one page, comparisons with earlier ones."""
