"""What the robot is: URDF text to a checked, frozen model, and its kinematics."""
