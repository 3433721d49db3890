"""The commands of clouds."""
