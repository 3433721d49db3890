"""Checks of the chain from a robot to the readers of its poses, link by link."""
