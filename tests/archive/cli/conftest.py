from helpers.command_fixtures import impatient, state_folder

__all__ = ["impatient", "state_folder"]
