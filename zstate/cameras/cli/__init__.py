"""The command of cameras."""
