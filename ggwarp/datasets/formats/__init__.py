# SPDX-License-Identifier: Apache-2.0
"""The bytes of files: what a header claims, whether a file is whole."""
