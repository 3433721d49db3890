"""The ros2 wire: what ROS 2 nodes with rmw_zenoh_cpp say and hear, byte for byte, without ROS. Pure."""
