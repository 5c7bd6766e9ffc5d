# SPDX-License-Identifier: Apache-2.0
"""One file a layout: what data sets, recorders and cameras write, each opened as a Dataset."""
