"""What the view brings: its command."""

from zstate.plugins import Command, Plugin

PLUGIN = Plugin(
    "view",
    commands={
        "view": Command(
            "zstate.view.cli:view_command", "Look", "The robots, drawn in a browser, and moved from there."
        ),
    },
    synonyms={
        "joint_state_publisher_gui": "view ROBOT --sliders",
        "rqt": "view",
        "rviz": "view",
        "rviz2": "view",
    },
    needs=("cameras", "clouds", "driving", "recording", "scans"),
)
