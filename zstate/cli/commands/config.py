"""zstate config: what commands go by, and who said so."""

from __future__ import annotations

from dataclasses import asdict

import click

from zstate.cli.options import json_option, plain_session_options, reading_clock_option, wire_option
from zstate.cli.output.console import print_json, print_result, print_status, print_wrapped
from zstate.cli.output.text_layout import in_columns


@click.command("config")
@click.option("--zenoh", "as_zenoh", is_flag=True, help="What Zenoh is told, beyond its own defaults.")
@json_option("One JSON object.")
@wire_option
@reading_clock_option
@plain_session_options
@click.pass_context
def config_command(context: click.Context, /, *, as_zenoh: bool, as_json: bool, **_: object) -> None:
    """Show what commands go by here, and where each value comes from.

    Options come before the environment, that before a Zenoh configuration, and that before the defaults.
    Give this command the options of another one to see what they come to. Every option of every command
    can stand in the environment: ZSTATE_COMMAND_OPTION, as in ZSTATE_TF_RATE. Passwords are not shown. Exit
    code 1 when something is wrong, such as a variable that nothing reads.

    \b
    zstate config
    zstate config --connect tcp/192.168.1.10:7447 --certs certs --identity desk
    zstate config --zenoh --mode lan
    zstate config --json
    """
    from zstate.cli.config.problems import problems
    from zstate.cli.config.settings import settings, zenoh_settings

    wrong = problems(context)
    if as_zenoh:
        told = zenoh_settings(context)
        print_json(told) if as_json else print_result(
            "\n".join(in_columns([(k, str(v)) for k, v in told.items()]))
        )
    elif as_json:
        print_json({"settings": [asdict(one) for one in settings(context)], "problems": wrong})
    else:
        rows = [(one.name, one.text, one.origin) for one in settings(context)]
        print_wrapped("\n".join(in_columns([("setting", "value", "from"), *rows])))
    for text in wrong:
        print_status(f"zstate: {text}", event="problem")
    raise SystemExit(1 if wrong else 0)
