"""Bridges: robots carried between the native wire, ROS 2 and ROS 1."""
