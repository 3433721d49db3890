"""Commands to the program that owns a robot's hardware, within limits. Not a safety-rated channel."""
