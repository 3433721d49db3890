"""Recordings: MCAP files and ROS 2 bags, recorded, read and played back."""
