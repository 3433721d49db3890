"""What the view brings: its command."""

from zstate.plugins import Command, Plugin

PLUGIN = Plugin(
    "view",
    commands={
        "view": Command(
            "zstate.view.cli:view_command", "Look", "The robots, drawn in a browser, and moved from there."
        ),
    },
    needs=("driving", "recording", "scans"),
)
