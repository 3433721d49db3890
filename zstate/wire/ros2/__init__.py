"""ROS 2 wire formats: messages and graph of rmw_zenoh_cpp nodes, byte for byte, without ROS. Pure."""
