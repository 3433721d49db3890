"""Point clouds."""

from typing import TYPE_CHECKING

from zstate._util.lazy_names import lazy_names

if TYPE_CHECKING:
    from zstate.clouds.cloud import Cloud
    from zstate.clouds.listener import CloudListener, PlacedCloud
    from zstate.clouds.publishers import CloudPublisher, CloudSource
    from zstate.clouds.simulated_lidar import SimulatedLidar

__all__ = ["Cloud", "CloudListener", "CloudPublisher", "CloudSource", "PlacedCloud", "SimulatedLidar"]

_HOMES = {
    "Cloud": "cloud",
    "CloudListener": "listener",
    "CloudPublisher": "publishers",
    "CloudSource": "publishers",
    "PlacedCloud": "listener",
    "SimulatedLidar": "simulated_lidar",
}

if not TYPE_CHECKING:  # type checkers would take any name for one of the package
    __getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
