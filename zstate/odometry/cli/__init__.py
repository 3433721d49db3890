"""The commands of odometry."""
