"""Lookups, side by side with other transform buffers: ``python -m bench.micro.lookup``."""
