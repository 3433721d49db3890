"""zstate robots: the robots that are known by name."""

from __future__ import annotations

import click

from zstate.cli.options import json_option
from zstate.cli.output.console import count_text, fail, print_json, print_result, print_status


@click.command("robots")
@click.argument("name", metavar="[TEXT]", default="")
@json_option("One JSON array of objects with name, path and origin.")
def robots_command(name: str, *, as_json: bool) -> None:
    """List the robots that every command takes by name, or those whose name contains TEXT.

    They come with zstate, from the package example-robot-data (pip install 'zstate[robots]'), and from
    what robot_descriptions has downloaded before. Any other robot is a path to its URDF or xacro file.
    For robots that run now, see `zstate ls`.

    \b
    zstate robots
    zstate robots ur
    zstate robots --json
    """
    from zstate.cli.output.text_layout import in_columns
    from zstate.model.load import catalog

    everything = catalog()
    entries = [entry for entry in everything if name.lower() in entry.name]
    if not entries and not as_json:
        fail(f"no robot known by name contains {name!r}; `zstate robots` lists all {len(everything)}")
    if as_json:
        print_json([{"name": one.name, "path": str(one.path), "origin": one.origin} for one in entries])
        return
    for line in in_columns([(entry.name, entry.origin) for entry in entries]):
        print_result(line)
    print_status(f"{count_text(len(entries), 'robot')}; a path to a URDF or xacro file works as well")
    if not any(entry.origin == "example-robot-data" for entry in everything):
        print_status("for many more: pip install 'zstate[robots]'")
