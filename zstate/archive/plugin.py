"""What archives bring: a command, and a store of recordings. Their messages are those of recordings."""

from zstate.plugins import Command, Plugin

PLUGIN = Plugin(
    "archive",
    commands={
        "archive": Command(
            "zstate.archive.cli.archive:archive_command", "Record", "Recordings of months as Parquet."
        ),
    },
    store="zstate.archive.store:ArchiveStore",
    needs=("recording",),
)
