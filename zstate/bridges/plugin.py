"""What bridges bring: their commands."""

from zstate.plugins import Command, Plugin

PLUGIN = Plugin(
    "bridges",
    commands={
        "bridge": Command(
            "zstate.bridges.cli.bridge:bridge_command",
            "Run",
            "Carry robots between zstate and ROS 2, both ways.",
        ),
        "ros1": Command(
            "zstate.bridges.cli.ros1:ros1_command", "Run", "A bridge to ROS 1, in either direction."
        ),
    },
    synonyms={
        "ros1_bridge": "ros1",
    },
    needs=("odometry",),
)
