"""The bridge to ROS 1, for whoever has rospy: joint states and transforms, in either direction."""
