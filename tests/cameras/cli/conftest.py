from helpers.command_fixtures import impatient, ros_router, state_folder

__all__ = ["impatient", "ros_router", "state_folder"]
