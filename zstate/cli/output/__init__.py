"""Output: what commands print and draw."""
