"""Laser scans and occupancy grids."""

from zstate.scans.grid import Grid, load_map
from zstate.scans.scan import Scan

__all__ = ["Grid", "Scan", "load_map"]
