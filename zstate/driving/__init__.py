"""Commands to the one program that owns a robot's hardware. Not a safety-rated channel."""
