"""Laser scans and occupancy grids."""

from typing import TYPE_CHECKING

from zstate._util.lazy_names import lazy_names

if TYPE_CHECKING:
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

_HOMES = {
    "Grid": "grid",
    "MapPublisher": "publishers",
    "PlacedScan": "listener",
    "RangeSource": "publishers",
    "Scan": "scan",
    "ScanListener": "listener",
    "ScanPublisher": "publishers",
    "SimulatedLaser": "simulated_laser",
    "dummy_scan": "simulated_laser",
    "load_map": "grid",
}

if not TYPE_CHECKING:  # type checkers would take any name for one of the package
    __getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
