"""`zstate battery`: prints the charge of a battery once."""

import click

import zstate
from zstate_battery import BATTERY


@click.command("battery")
@click.argument("robot")
def battery_command(robot: str) -> None:
    """Print the charge of the battery of ROBOT."""
    with zstate.connect() as session, zstate.StreamListener(session, robot, BATTERY) as listener:
        received = listener.get(10.0)
        click.echo("no battery" if received is None else f"{100 * received.message.charge:.0f} %")
