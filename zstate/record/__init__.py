"""Recordings as files: channels of CDR messages in MCAP, and in the bags of ROS 2, written and read."""
