"""The bridge to ROS 1: joint states and transforms, in either direction. Needs rospy."""
