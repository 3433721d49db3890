"""Checks of credential files before Zenoh opens them: its own errors do not name the cause."""

from __future__ import annotations

import ssl
from pathlib import Path

from zstate.errors import ConfigError
from zstate.net.security.credentials import Credentials, File

_OTHERS = 0o007


def check_files(credentials: Credentials) -> None:
    """Raise ConfigError for a file that is missing, open to all users of this machine, or malformed."""
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
    """TLS context of a client with these credentials, which have a ca. Raises ConfigError."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    assert credentials.ca is not None
    try:
        context.load_verify_locations(credentials.ca)
    except OSError:
        raise ConfigError(
            f"{_name(credentials.ca)} holds no certificate in PEM", path=str(credentials.ca)
        ) from None
    if credentials.certificate is None:
        return context
    try:
        # Without a password, OpenSSL asks for one on the terminal.
        context.load_cert_chain(credentials.certificate, credentials.key, password="")
    except OSError as error:
        both = f"{_name(credentials.certificate)} and {_name(credentials.key or '')}"
        text = f"{both} are not a certificate and its unencrypted key in PEM"
        if isinstance(error, ssl.SSLError) and error.reason == "KEY_VALUES_MISMATCH":
            text = f"{both} do not belong together: the certificate is of another key"
        raise ConfigError(text, path=str(credentials.key)) from None
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
        raise ConfigError(f"the first line of the password file {str(file)!r} is empty", path=str(file))
    return lines[0]


def _check_readable(file: File) -> None:
    try:
        with Path(file).open("rb"):
            pass
    except OSError as error:
        hint = "; do you need another user or group to read it?" if isinstance(error, PermissionError) else ""
        raise ConfigError(f"{_name(file)} cannot be read: {error.strerror}{hint}", path=str(file)) from None


def _check_users(file: File) -> None:
    """Zenoh accepts user:password lines, no comments, and uses the last of several lines of one user."""
    line_numbers: dict[str, int] = {}
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
        if line.strip() and user in line_numbers:
            text = f"{file}, line {number}: the user {user!r} is already in line {line_numbers[user]}"
            raise ConfigError(text, path=str(file))
        line_numbers[user] = number
    if not set(line_numbers) - {""}:
        raise ConfigError(f"{_name(file)} has no user; no client could connect", path=str(file))


def _name(file: File) -> str:
    return repr(str(file))
