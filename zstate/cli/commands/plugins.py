"""zstate plugins: what other packages add to zstate."""

from __future__ import annotations

from typing import Any

import click

from zstate.cli import options
from zstate.cli.output.console import print_json, print_result, print_status, print_wrapped


@click.command("plugins")
@options.json_option("One JSON array.")
def plugins_command(*, as_json: bool) -> None:
    """List the packages that add streams and commands to zstate, and what cannot be used of them.

    A package does so by an entry point in the group zstate.plugins; "Add your own stream" in the guides shows
    one. The exit code is 1 if something cannot be used.

    \b
    zstate plugins
    zstate plugins --json
    """
    from zstate.cli.commands import own_commands
    from zstate.other_plugins import found_plugins

    own = own_commands()
    facts: list[dict[str, Any]] = []
    for one in found_plugins():
        taken = [name for name in one.plugin.commands if name in own]
        problems = [one.problem] if one.problem else []
        problems += [f"the command {name!r} is not used: zstate brings one of that name" for name in taken]
        facts.append(
            {
                "plugin": one.entry,
                "package": one.distribution,
                "version": one.version,
                "streams": [row.name for row in one.plugin.streams],
                "commands": [name for name in one.plugin.commands if name not in own],
                "problems": problems,
            }
        )
    if as_json:
        print_json(facts)
    elif not facts:
        print_status("no other package adds to zstate: none has an entry point in the group zstate.plugins")
    for one in () if as_json else facts:
        print_result(f"{one['plugin']}  ({one['package']} {one['version']})")
        for kind in ("streams", "commands"):
            if one[kind]:
                print_wrapped(f"  {kind}: {', '.join(one[kind])}")
        for problem in one["problems"]:
            print_wrapped(f"  not used: {problem}")
    if any(one["problems"] for one in facts):
        raise SystemExit(1)
