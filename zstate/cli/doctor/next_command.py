"""What to do next, said so that it looks where doctor has looked."""

from __future__ import annotations

import shlex
from importlib import import_module

from zstate.cli.network import Network


def looking_there(command: str, network: Network, wire: str) -> str:
    """``command`` with the options that doctor was given, as far as it takes them and has none of its own."""
    text, mark, comment = command.partition("  #")
    program, *said = text.split()
    if program != "zstate":
        return command
    taken = _options(said[0])
    wires = ("--wire", wire) if wire != "native" else ()
    for group in (wires, _connecting(network)):
        if group and group[0] in taken and group[0] not in said:
            text += f" {shlex.join(group)}"
    return text + mark + comment


def _options(command: str) -> set[str]:
    made = getattr(import_module(f"zstate.cli.commands.{command}"), f"{command}_command")
    return {option for parameter in made.params for option in parameter.opts}


def _connecting(network: Network) -> tuple[str, ...]:
    return tuple(word for endpoint in network.connect for word in ("--connect", endpoint))
