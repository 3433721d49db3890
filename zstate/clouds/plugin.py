"""What clouds bring: the stream of lidars and depth cameras; and a command."""

from zstate.plugins import Command, Plugin
from zstate.streams import Stream

_CLOUD_BYTES = 60_100_000
"""A cloud of the most bytes, with the longest names, takes less on each wire."""

CLOUD = Stream(
    "cloud",
    "zstate.clouds.messages:PointCloud",
    summary="points of a lidar or a depth camera",
    named=True,
    bulk=True,
    max_bytes=_CLOUD_BYTES,
    start="start one: `zstate cloud {robot} --frame FRAME --simulate`",
    ros="zstate.clouds.ros2:CLOUD_STREAM",
    document="zstate.clouds.documents:cloud_document",
    columns="zstate.clouds.documents:cloud_columns",
)

PLUGIN = Plugin(
    "clouds",
    streams=(CLOUD,),
    commands={
        "cloud": Command(
            "zstate.clouds.cli.cloud:cloud_command", "Write", "Publish the clouds of a simulated lidar."
        ),
    },
    checks="zstate.clouds.cli.checks:CloudChecks",
)
