"""Credentials of a session: certificates, user and password, and the authority it trusts.

Their files are checked before Zenoh opens them: its own errors do not name the cause.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from zstate.errors import ConfigError, InvalidInput

if TYPE_CHECKING:
    import ssl

AUTHORITY = "ca"
File = str | os.PathLike[str]

_ENCRYPTED = ("tls/", "quic/")
_OTHERS = 0o007
_IDENTITY = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")  # a common name has 64 characters at most


def check_identity(name: str, *, reserved: str | None = None) -> None:
    """Raise InvalidInput unless ``name`` can be that of a certificate or a user, and is not ``reserved``."""
    if not _IDENTITY.fullmatch(name) or name == reserved:
        raise InvalidInput(
            f"{name!r} cannot be the name of an identity; use up to 64 of A-Z a-z 0-9 . _ -, beginning with "
            f"a letter or digit{'' if reserved is None else f', and not {reserved!r}'}"
        )


@dataclass(frozen=True, slots=True)
class CertificateFiles:
    """A certificate, which is public, and its key, which only its owner may read."""

    certificate: Path
    key: Path

    @classmethod
    def for_name(cls, folder: File, name: str) -> CertificateFiles:
        """The files of ``zstate certs`` for ``name``."""
        return cls(Path(folder) / f"{name}.pem", Path(folder) / f"{name}.key")

    @property
    def existing(self) -> tuple[Path, ...]:
        """The files that exist."""
        return tuple(path for path in (self.certificate, self.key) if path.exists())


@dataclass(frozen=True, slots=True, kw_only=True)
class Credentials:
    """The identity of a session and the authority it trusts: certificates, user and password, or both.

    ``ca`` is the file of the authority whose certificates are trusted; with it all links are encrypted, and
    endpoints are tls/... or quic/... . ``certificate`` and its ``key`` identify this session, for
    access control by the common name. A session that listens needs them, and then requires a certificate
    of each client. Files are PEM, keys not encrypted.

    ``user`` and ``password`` identify this session to routers that require them. ``users`` is a file of
    user:password lines: the users that may connect to this session, usually a router. Without ``ca``
    passwords do not prevent eavesdropping.

    Raises ConfigError for an invalid combination. Files are read when the session opens.
    """

    user: str | None = None
    password: str | None = field(default=None, repr=False)
    ca: File | None = None
    certificate: File | None = None
    key: File | None = None
    users: File | None = None

    def __post_init__(self) -> None:
        for one, other in (("user", "password"), ("certificate", "key")):
            has, lacks = (one, other) if getattr(self, other) is None else (other, one)
            if getattr(self, has) is not None and getattr(self, lacks) is None:
                raise ConfigError(f"there is a {has} and no {lacks}; give both, or neither", path=lacks)
        if self.user is not None and (not self.user or ":" in self.user or not self.password):
            raise ConfigError(
                "a user's name is not empty and has no ':', a password is not empty", path="user"
            )
        if self.certificate is not None and self.ca is None:
            raise ConfigError(
                "there is a certificate and no ca; give the ca.pem that checks the certificates of others",
                path="ca",
            )
        if self.user is None and self.ca is None and self.users is None:
            raise ConfigError("these credentials are empty; give user and password, ca, or users", path="")

    @classmethod
    def from_folder(
        cls,
        folder: File,
        name: str,
        *,
        user: str | None = None,
        password: str | None = None,
        users: File | None = None,
    ) -> Credentials:
        """The files of ``zstate certs`` for ``name``. Raises ConfigError with the existing identities."""
        files = CertificateFiles.for_name(folder, name)
        if len(files.existing) < 2:
            names = sorted({path.stem for path in Path(folder).glob("*.pem")} - {AUTHORITY})
            known = f"its identities are {', '.join(map(repr, names))}" if names else "it has none"
            raise ConfigError(
                f"{str(folder)!r} has no identity {name!r} ({files.certificate.name} and {files.key.name}); "
                f"{known}; `zstate certs {folder} --identity {name}` makes one for tests",
                path=str(files.certificate),
            )
        return cls(
            ca=Path(folder) / f"{AUTHORITY}.pem",
            certificate=files.certificate,
            key=files.key,
            user=user,
            password=password,
            users=users,
        )

    @property
    def identity(self) -> str:
        """The user and certificate of this session, for messages; empty if it has neither."""
        parts = [f"user {self.user!r}"] if self.user else []
        if self.certificate is not None:
            parts.append(f"the certificate {str(self.certificate)!r}")
        return " with ".join(parts)

    def check_endpoints(self, endpoints: Iterable[str], listen: Iterable[str]) -> None:
        """Raise ConfigError for an endpoint that these credentials cannot protect."""
        for endpoint in (*endpoints, *listen):
            if self.ca is not None and not endpoint.startswith(_ENCRYPTED):
                protocol, _, rest = endpoint.partition("/")
                raise ConfigError(
                    f"{endpoint!r} is not encrypted: over {protocol} no certificate is shown and none is "
                    f"checked; write 'tls/{rest}', there and where it listens",
                    path=endpoint,
                )
        for endpoint in listen:
            if self.certificate is None and endpoint.startswith(_ENCRYPTED):
                raise ConfigError(
                    f"listening at {endpoint!r} needs a certificate and its key, which these credentials "
                    "lack; `zstate certs DIR --server NAME` makes them for tests",
                    path=endpoint,
                )

    def check_files(self) -> None:
        """Raise ConfigError for a file that is missing, open to all users of this machine, or malformed."""
        for file in (self.ca, self.certificate, self.key, self.users):
            if file is not None:
                _check_readable(file)
        for secret in (self.key, self.users):
            if secret is not None:
                check_private(secret)
        if self.ca is not None:
            client_context(self)
        if self.users is not None:
            _check_users(self.users)

    def settings(self) -> dict[str, object]:
        """The settings of Zenoh, by path in its configuration."""
        settings: dict[str, object] = {}
        if self.ca is not None:
            # Names are always checked, or every identity of the authority could pose as the router.
            tls: dict[str, object] = {"root_ca_certificate": _path(self.ca), "verify_name_on_connect": True}
            if self.certificate is not None:
                for side in ("listen", "connect"):
                    tls[f"{side}_certificate"] = _path(self.certificate)
                    tls[f"{side}_private_key"] = _path(self.key)
                tls["enable_mtls"] = True
            settings["transport/link/tls"] = tls
        users = {"user": self.user, "password": self.password, "dictionary_file": _path(self.users)}
        if any(users.values()):
            settings["transport/auth/usrpwd"] = {
                name: value for name, value in users.items() if value is not None
            }
        return settings


def _path(path: File | None) -> str | None:
    return None if path is None else str(Path(path).absolute())


def client_context(credentials: Credentials) -> ssl.SSLContext:
    """TLS context of a client with these credentials, which have a ca. Raises ConfigError."""
    import ssl  # noqa: PLC0415  # which few need

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
