"""What Foxglove's server brings: its command."""

from zstate.plugins import Command, Plugin

PLUGIN = Plugin(
    "foxglove",
    commands={
        "foxglove": Command("zstate.foxglove.cli:foxglove_command", "Look", "The robots, live in Foxglove."),
    },
    synonyms={
        "foxglove_bridge": "foxglove",
        "lichtblick": "foxglove",
    },
    needs=("recording",),
)
