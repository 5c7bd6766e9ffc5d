# SPDX-License-Identifier: Apache-2.0
"""One file an app: what phones with LiDAR or Face ID record, each opened as a Dataset."""
