"""zstate init: a file for `zstate up` to begin with."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

import click

from zstate.cli.options import load_robot, name_option, xacro_arguments
from zstate.cli.output.console import fail, print_result, print_status


@click.command("init")
@click.argument("robot", default="rrbot", metavar="[ROBOT]")
@xacro_arguments
@click.option("-o", "--output", metavar="FILE", help="Where to; default: NAME.toml, - for standard output.")
@click.option("--force", is_flag=True, help="Also where there is such a file already.")
@name_option
def init_command(
    robot: str, xacro_args: dict[str, str], output: str | None, force: bool, name: str | None
) -> None:
    """Write a commented file for ROBOT, which `zstate up` runs as it is.

    ROBOT is a name such as panda, or a URDF or xacro file; rrbot, which comes with zstate, unless given.
    NAME:=VALUE are xacro arguments.

    \b
    zstate init panda
    zstate up panda.toml
    zstate init arm.urdf -o cell.toml
    zstate init arm.urdf.xacro prefix:=left_
    """
    from zstate.cli.up.example import example_text
    from zstate.model.catalog import is_path

    model, called = load_robot(robot, name, xacro_args)
    file = Path(output if output not in (None, "-") else f"{called}.toml")
    source = os.path.relpath(robot, file.parent) if is_path(robot) else robot
    text = example_text(shlex.quote(file.name), source, called, model, xacro_args)
    if output == "-":
        print_result(text.rstrip("\n"))
        return
    try:
        with file.open("w" if force else "x", encoding="utf-8") as written:
            written.write(text)
    except FileExistsError:
        fail(f"{str(file)!r} exists; --force replaces it, -o FILE writes another")
    except OSError as error:
        fail(f"{str(file)!r} cannot be written: {error.strerror}")
    print_status(f"wrote {file}; start it with `zstate up {shlex.quote(str(file))}`")
