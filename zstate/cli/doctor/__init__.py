"""The chain from a robot to whoever wants its poses, looked at link by link."""
