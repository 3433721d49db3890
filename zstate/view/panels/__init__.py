"""Panels: what stands beside the picture, one class each, put together by the board."""
