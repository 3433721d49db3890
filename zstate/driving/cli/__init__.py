"""The commands of driving."""
