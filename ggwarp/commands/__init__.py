# SPDX-License-Identifier: Apache-2.0
"""The subcommands of ``ggwarp`` beside ``run`` and ``objects``, a file each."""
