"""zstate config: effective settings and where they come from."""

from __future__ import annotations

from dataclasses import asdict

import click

from zstate.cli.options import json_option, plain_session_options, reading_clock_option, wire_option
from zstate.cli.output.console import print_json, print_result, print_status, print_wrapped
from zstate.cli.output.text_layout import in_columns


@click.command("config")
@click.option(
    "--zenoh", "as_zenoh", is_flag=True, help="The Zenoh settings that differ from Zenoh's defaults."
)
@json_option("One JSON object.")
@wire_option
@reading_clock_option
@plain_session_options
@click.pass_context
def config_command(context: click.Context, /, *, as_zenoh: bool, as_json: bool, **_: object) -> None:
    """Show the effective settings of commands, and where each value comes from.

    Precedence: options, environment, Zenoh configuration file, defaults. Pass the options of another command
    to see their effect. Every option of every command can be set in the environment as
    ZSTATE_COMMAND_OPTION, for instance ZSTATE_TF_RATE. Passwords are not shown. Exit code 1 if there is a
    problem, such as a variable that nothing reads.

    \b
    zstate config
    zstate config --connect tcp/192.168.1.10:7447 --certs certs --identity desk
    zstate config --zenoh --mode lan
    zstate config --json
    """
    from zstate.cli.effective_config import problems, settings, zenoh_settings

    found = problems(context)
    if as_zenoh:
        differences = zenoh_settings(context)
        rows = [(path, str(value)) for path, value in differences.items()]
        print_json(differences) if as_json else print_result("\n".join(in_columns(rows)))
    elif as_json:
        print_json({"settings": [asdict(one) for one in settings(context)], "problems": found})
    else:
        rows = [(one.name, one.text, one.origin) for one in settings(context)]
        print_wrapped("\n".join(in_columns([("setting", "value", "from"), *rows])))
    for text in found:
        print_status(f"zstate: {text}", event="problem")
    raise SystemExit(1 if found else 0)
