"""Laser scans and occupancy grids."""

from zstate.scans.grid import Grid
from zstate.scans.scan import Scan

__all__ = ["Grid", "Scan"]
