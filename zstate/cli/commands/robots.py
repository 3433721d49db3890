"""zstate robots: the catalog of robot models."""

from __future__ import annotations

import click

from zstate.cli import options
from zstate.cli.output.console import count_text, fail, print_json, print_result, print_status


@click.command("robots")
@click.argument("name", metavar="[TEXT]", default="")
@options.json_option("One JSON array of objects with name, path and origin.")
def robots_command(name: str, *, as_json: bool) -> None:
    """List the robot models that commands accept by name, or those whose name contains TEXT.

    They come with zstate, from the package example-robot-data (pip install 'zstate[robots]'), and from
    earlier downloads of robot_descriptions. For any other robot, pass the path of its URDF or xacro file.
    `zstate ls` lists running robots.

    \b
    zstate robots
    zstate robots ur
    zstate robots --json
    """
    from zstate.cli.output.text_layout import in_columns
    from zstate.model.load import catalog

    everything = catalog()
    has_extra = any(entry.origin == "example-robot-data" for entry in everything)
    more = "" if has_extra else "for many more: pip install 'zstate[robots]'"
    entries = [entry for entry in everything if name.lower() in entry.name]
    if not entries and not as_json:
        found = f"no name of a robot model contains {name!r}; `zstate robots` lists all {len(everything)}"
        fail("; ".join(filter(None, (found, more))))
    if as_json:
        print_json([{"name": one.name, "path": str(one.path), "origin": one.origin} for one in entries])
        return
    for line in in_columns([(entry.name, entry.origin) for entry in entries]):
        print_result(line)
    print_status(f"{count_text(len(entries), 'robot')}; a path to a URDF or xacro file works as well")
    if more:
        print_status(more)
