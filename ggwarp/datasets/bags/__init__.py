# SPDX-License-Identifier: Apache-2.0
"""ROS bags and MCAP files: messages by topic and time, pictures, where cameras are, and their reader."""
