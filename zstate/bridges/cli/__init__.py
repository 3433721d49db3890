"""The commands of bridges."""
