"""Who a command is to others: the options that say so, and the credentials they mean."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from zstate.net.security import Credentials

Command = TypeVar("Command", bound=Callable[..., Any])

PASSWORD_VARIABLE = "ZSTATE_PASSWORD"

_OPTIONS = (
    click.option(
        "--certs",
        type=click.Path(exists=True, file_okay=False),
        metavar="DIR",
        envvar="ZSTATE_CERTS",
        help="Encrypt, with the ca.pem, NAME.pem and NAME.key of this folder (`zstate certs` makes such).",
    ),
    click.option(
        "--identity",
        metavar="NAME",
        envvar="ZSTATE_IDENTITY",
        help="Which certificate of --certs to show; access control knows this command by it.",
    ),
    click.option(
        "--user",
        metavar="NAME",
        envvar="ZSTATE_USER",
        help=f"For a router that asks; its password is in {PASSWORD_VARIABLE}, or in --password-file.",
    ),
    click.option(
        "--password-file",
        type=click.Path(exists=True, dir_okay=False),
        metavar="FILE",
        envvar="ZSTATE_PASSWORD_FILE",
        help="A file that only you can read; its first line is the password of --user.",
    ),
)
_USERS = click.option(
    "--users",
    type=click.Path(exists=True, dir_okay=False),
    metavar="FILE",
    envvar="ZSTATE_USERS",
    help="Who may connect: user:password lines, in a file that only you can read; default: everybody.",
)


def identity_options(command: Command) -> Command:
    """Give a command the options of who it is; it gets them as ``credentials``."""
    return _with_credentials(command, _OPTIONS)


def router_identity_options(command: Command) -> Command:
    """The same, and who may connect."""
    return _with_credentials(command, (*_OPTIONS, _USERS))


def plain_identity_options(command: Command) -> Command:
    """The options of ``identity_options`` as they are said, and nothing made of them."""
    return _with_options(command, _OPTIONS)


def _with_credentials(command: Command, options: Sequence[Callable[[Any], Any]]) -> Command:
    @functools.wraps(command)
    def with_credentials(
        *,
        certs: str | None,
        identity: str | None,
        user: str | None,
        password_file: str | None,
        users: str | None = None,
        **others: Any,
    ) -> Any:
        credentials = credentials_of(certs, identity, user, password_file, users)
        return command(credentials=credentials, **others)

    return _with_options(with_credentials, options)


def _with_options(command: Any, options: Sequence[Callable[[Any], Any]]) -> Any:
    for option in reversed(options):
        command = option(command)
    return command


def credentials_of(
    certs: str | None,
    identity: str | None,
    user: str | None,
    password_file: str | None,
    users: str | None,
) -> Credentials | None:
    """What these options mean. Raises UsageError for half a pair, ConfigError for what cannot be used."""
    if (certs is None) != (identity is None):
        given, lacking = ("--certs", "--identity NAME") if identity is None else ("--identity", "--certs DIR")
        raise click.UsageError(f"{given} is of no use without {lacking}")
    if password_file is not None and user is None:
        raise click.UsageError("--password-file is of no use without --user NAME")
    if certs is None and user is None and users is None:
        return None
    from zstate.net.security import Credentials

    password = None if user is None else _password(user, password_file)
    if certs is None or identity is None:
        return Credentials(user=user, password=password, users=users)
    return Credentials.from_folder(certs, identity, user=user, password=password, users=users)


def _password(user: str, file: str | None) -> str:
    # Never on the command line, which every user of the machine can read.
    if file is None:
        password = os.environ.get(PASSWORD_VARIABLE)
        if not password:
            raise click.UsageError(
                f"the password of {user!r} is missing; put it into {PASSWORD_VARIABLE} or a --password-file"
            )
        return password
    from zstate.net.credential_files import password_in

    return password_in(file)
