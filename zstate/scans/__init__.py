"""Laser scans and occupancy grids."""

from zstate.scans.grid import Grid, load_map
from zstate.scans.listener import PlacedScan, ScanListener
from zstate.scans.publishers import MapPublisher, RangeSource, ScanPublisher
from zstate.scans.scan import Scan
from zstate.scans.simulated_laser import SimulatedLaser, dummy_scan

__all__ = [
    "Grid",
    "MapPublisher",
    "PlacedScan",
    "RangeSource",
    "Scan",
    "ScanListener",
    "ScanPublisher",
    "SimulatedLaser",
    "dummy_scan",
    "load_map",
]
