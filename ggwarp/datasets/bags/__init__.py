# SPDX-License-Identifier: Apache-2.0
"""What lies in ROS bags and MCAP files: messages by topic and time, pictures, where cameras are."""
