"""What scans bring: the streams of laser scanners and of maps; and commands."""

from zstate.plugins import Command, Plugin
from zstate.streams import LATCHED_BYTES, Stream

_MESSAGES = "zstate.scans.messages"
_SCAN_BYTES = 810_000
"""A scan of the most rays, with intensities, takes less on each wire."""

SCAN = Stream(
    "scan",
    f"{_MESSAGES}:LaserScan",
    summary="ranges of a laser scanner",
    named=True,
    max_bytes=_SCAN_BYTES,
    start="start one: `zstate scan {robot} --frame FRAME --dummy`",
    ros="zstate.scans.ros2:SCAN_STREAM",
    document="zstate.scans.documents:scan_document",
    full_document="zstate.scans.documents:full_scan_document",
)
MAP = Stream(
    "map",
    f"{_MESSAGES}:OccupancyGrid",
    summary="an occupancy grid of a place",
    named=True,
    latched=True,
    max_bytes=LATCHED_BYTES,
    start="start one: `zstate map FILE.yaml --name {robot}`",
    ros="zstate.scans.ros2:MAP_STREAM",
    document="zstate.scans.documents:map_document",
)

PLUGIN = Plugin(
    "scans",
    streams=(SCAN, MAP),
    commands={
        "scan": Command(
            "zstate.scans.cli.scan:scan_command", "Write", "Publish the scans of a simulated or dummy laser."
        ),
        "map": Command("zstate.scans.cli.map:map_command", "Write", "Publish the map of a place."),
    },
    synonyms={
        "dummy_laser": "scan ROBOT --frame FRAME --dummy",
        "dummy_map_server": "map FILE.yaml",
        "laser": "scan ROBOT --frame FRAME --simulate MAP.yaml",
        "lidar": "scan ROBOT --frame FRAME --simulate MAP.yaml",
        "map_server": "map FILE.yaml",
    },
    checks="zstate.scans.cli.checks:MapChecks",
)
