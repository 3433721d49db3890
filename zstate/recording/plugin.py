"""What recording brings: the commands on MCAP files."""

from zstate.plugins import Command, Plugin

PLUGIN = Plugin(
    "recording",
    commands={
        "record": Command(
            "zstate.recording.cli.record:record_command", "Record", "Record robots into MCAP files."
        ),
        "replay": Command(
            "zstate.recording.cli.replay:replay_command", "Record", "Publish a recording again."
        ),
        "recover": Command(
            "zstate.recording.cli.recover:recover_command",
            "Record",
            "A complete file of a recording that was cut off.",
        ),
        "info": Command("zstate.recording.cli.info:info_command", "Record", "The contents of a recording."),
        "export": Command(
            "zstate.recording.cli.export:export_command",
            "Record",
            "The joint states and poses of a recording as a table.",
        ),
        "snapshot": Command(
            "zstate.recording.cli.snapshot:snapshot_command",
            "Record",
            "Save the state of robots to a file, and publish it again.",
        ),
        "plot": Command(
            "zstate.recording.cli.plot:plot_command",
            "Look",
            "Joint positions, or the path of a frame, over time.",
        ),
    },
    synonyms={
        "bag": "record | replay | info",
        "play": "replay",
        "ros2_bag": "record | replay | info",
        "rosbag": "record | replay | info",
        "rqt": "plot",
        "rqt_plot": "plot",
    },
)
