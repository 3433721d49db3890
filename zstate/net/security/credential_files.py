"""The files that credentials name, looked into before Zenoh is given them; of these it says little."""

from __future__ import annotations

import ssl
from pathlib import Path

from zstate.errors import ConfigError
from zstate.net.security.credentials import Credentials, File

_OTHERS = 0o007


def check_files(credentials: Credentials) -> None:
    """Raise ConfigError for a file that is missing, open to everybody, or not what it should be."""
    for file in (credentials.ca, credentials.certificate, credentials.key, credentials.users):
        if file is not None:
            _check_readable(file)
    for secret in (credentials.key, credentials.users):
        if secret is not None:
            check_private(secret)
    if credentials.ca is not None:
        client_context(credentials)
    if credentials.users is not None:
        _check_users(credentials.users)


def client_context(credentials: Credentials) -> ssl.SSLContext:
    """What a TLS client with these credentials, which have a ca, trusts and shows. Raises ConfigError."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    assert credentials.ca is not None
    try:
        context.load_verify_locations(credentials.ca)
    except OSError:
        raise ConfigError(
            f"{_name(credentials.ca)} holds no certificate in PEM", path=str(credentials.ca)
        ) from None
    if credentials.certificate is not None:
        _load_pair(context, credentials.certificate, credentials.key)
    return context


def check_private(file: File) -> None:
    """Raise ConfigError if every user of this machine can read or write the file."""
    mode = Path(file).stat().st_mode & 0o777
    if mode & _OTHERS:
        raise ConfigError(
            f"{_name(file)} is open to every user of this machine (mode {mode:03o}); it is a secret: "
            f"`chmod 600 {file}`",
            path=str(file),
        )


def password_in(file: File) -> str:
    """The first line of a file that only its owner may read. Raises ConfigError."""
    _check_readable(file)
    check_private(file)
    try:
        lines = Path(file).read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"the password file {str(file)!r} cannot be read: {error}", path=str(file)
        ) from None
    if not lines or not lines[0]:
        raise ConfigError(f"the password file {str(file)!r} has nothing in its first line", path=str(file))
    return lines[0]


def _load_pair(context: ssl.SSLContext, certificate: File, key: File | None) -> None:
    try:
        # A password is asked for on the terminal unless one is given.
        context.load_cert_chain(certificate, key, password="")
    except OSError as error:
        both = f"{_name(certificate)} and {_name(key or '')}"
        told = f"{both} are not a certificate and its unencrypted key in PEM"
        if isinstance(error, ssl.SSLError) and error.reason == "KEY_VALUES_MISMATCH":
            told = f"{both} do not belong together: the certificate is of another key"
        raise ConfigError(told, path=str(key)) from None


def _check_readable(file: File) -> None:
    try:
        with Path(file).open("rb"):
            pass
    except OSError as error:
        hint = "; do you need another user or group to read it?" if isinstance(error, PermissionError) else ""
        raise ConfigError(f"{_name(file)} cannot be read: {error.strerror}{hint}", path=str(file)) from None


def _check_users(file: File) -> None:
    """Zenoh takes user:password lines, no comments, and the last of several lines of one user."""
    known: dict[str, int] = {}
    try:
        lines = Path(file).read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise ConfigError(f"{_name(file)} is not UTF-8 text", path=str(file)) from None
    for number, line in enumerate(lines, 1):
        user, colon, password = (part.strip() for part in line.partition(":"))
        if line.strip() and not (user and colon and password):
            raise ConfigError(
                f"{file}, line {number}: write user:password; comments are not allowed", path=str(file)
            )
        if line.strip() and user in known:
            raise ConfigError(
                f"{file}, line {number}: the user {user!r} stands in line {known[user]} already",
                path=str(file),
            )
        known[user] = number
    if not set(known) - {""}:
        raise ConfigError(f"{_name(file)} names no user, so that nobody could connect", path=str(file))


def _name(file: File) -> str:
    return repr(str(file))
