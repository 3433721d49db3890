"""The commands: those of the core, each in a module of its name, and those of plugins."""

from __future__ import annotations

from functools import cache

import click

from zstate._util.lazy_names import loaded
from zstate.cli.output.console import fail
from zstate.other_plugins import found_plugins
from zstate.plugins import Command, built_in_plugins

_CORE = {
    "demo": ("Start here", "A robot that moves, its state over Zenoh, and a live table of it."),
    "publish": ("Write", "Publish a robot's state: its model, fixed edges, and transforms."),
    "joints": ("Write", "Publish a sine on every joint, and nothing else."),
    "static": ("Write", "Publish one edge that never moves, until Ctrl-C."),
    "transform": ("Write", "Publish moving edges: one pose at a rate, or lines of JSON."),
    "tf": ("Look", "The pose of one frame in another."),
    "monitor": ("Look", "How samples come in, by edge or by robot: rates, latencies, losses."),
    "tree": ("Look", "The frames of the announced robots, as a tree."),
    "ls": ("Look", "The announced robots and their writers."),
    "graph": ("Look", "The writers and readers of each stream."),
    "echo": ("Look", "Joint states, transforms, odometry, sensors or maps as documents."),
    "hz": ("Look", "The rate at which samples come in."),
    "doctor": ("Look", "What is wrong, and what to do next."),
    "wait": ("Look", "Wait until a robot, a pose or a router is there."),
    "config": ("Look", "The settings in effect, and where each comes from."),
    "check": ("Look", "The contents and findings of a robot model."),
    "robots": ("Look", "The robots that are known by name, such as panda."),
    "up": ("Run", "Start several processes from one file."),
    "init": ("Run", "Write a commented file for `zstate up`."),
    "plugins": ("Run", "What other packages add: streams and commands."),
    "completion": ("Run", "Set up completion in a shell."),
}
"""The section of the help, and the summary, of each command whose module is in this folder."""

SECTIONS = ("Start here", "Write", "Drive", "Look", "Record", "Run")
"""Those of the help, in order."""


@cache
def own_commands() -> dict[str, Command]:
    """The commands of zstate by name, in the order of the help: in each section those of the core first."""
    core = {name: Command(f"{__name__}.{name}:{name}_command", *row) for name, row in _CORE.items()}
    core |= {name: plugin.command(name) for plugin in built_in_plugins() for name in plugin.commands}
    return dict(sorted(core.items(), key=lambda row: SECTIONS.index(row[1].section)))


def load_command(name: str) -> click.Command:
    """``zstate NAME``, a command of zstate."""
    command = loaded(own_commands()[name].reference)
    assert isinstance(command, click.Command)
    return command


def load_other_command(name: str) -> click.Command | None:
    """The command ``name`` that another package brings; None if none does. Fails if it cannot be loaded."""
    for one in found_plugins():
        if name in one.plugin.commands:
            reference = one.plugin.command(name).reference
            try:
                command = loaded(reference)
            except Exception as error:  # whatever another package's module does when it is imported
                problem = f"cannot be loaded: {type(error).__name__}: {error}"
                fail(f"the command {name!r} of {one.distribution} ({reference}) {problem}")
            if not isinstance(command, click.Command):
                fail(f"the command {name!r} of {one.distribution} ({reference}) is no click.Command")
            return command
    return None
