# SPDX-License-Identifier: Apache-2.0
"""What to run on a GPU machine that is had for a quarter of an hour: ``gpu_day.sh`` says how."""
