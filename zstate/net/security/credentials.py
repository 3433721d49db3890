"""Who a session is to others, and whom it trusts."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from zstate.errors import ConfigError

AUTHORITY = "ca"
File = str | os.PathLike[str]

_ENCRYPTED = ("tls/", "quic/")


@dataclass(frozen=True, slots=True)
class CertificateFiles:
    """A certificate, which everybody may see, and its key, which only its owner may read."""

    certificate: Path
    key: Path

    @classmethod
    def for_name(cls, folder: File, name: str) -> CertificateFiles:
        """Where ``zstate certs`` keeps those of ``name``."""
        return cls(Path(folder) / f"{name}.pem", Path(folder) / f"{name}.key")

    @property
    def existing(self) -> tuple[Path, ...]:
        """Those of the two that are there."""
        return tuple(path for path in (self.certificate, self.key) if path.exists())


@dataclass(frozen=True, slots=True, kw_only=True)
class Credentials:
    """Who a session is to others, and whom it trusts: certificates, a name and password, or both.

    ``ca`` is the file of the authority whose certificates are trusted; with it everything is
    encrypted, and endpoints are tls/... or quic/... . ``certificate`` and its ``key`` say who this session
    is; access control knows it by the common name. Whoever listens needs them, and then demands
    a certificate of whoever connects. Files are PEM, keys not encrypted.

    ``user`` and ``password`` are what others ask for. ``users`` is a file of user:password lines: who may
    connect to this session, which is usually a router. They keep nobody from listening in without ``ca``.

    Raises ConfigError for a combination that cannot be used. Files are read when the session opens.
    """

    user: str | None = None
    password: str | None = field(default=None, repr=False)
    ca: File | None = None
    certificate: File | None = None
    key: File | None = None
    users: File | None = None

    def __post_init__(self) -> None:
        if (self.user is None) != (self.password is None):
            has, lacks = ("a user", "password") if self.password is None else ("a password", "user")
            raise ConfigError(f"there is {has} and no {lacks}; give both, or neither", path=lacks)
        if self.user is not None and (not self.user or ":" in self.user or not self.password):
            raise ConfigError(
                "a user's name is not empty and has no ':', a password is not empty", path="user"
            )
        if (self.certificate is None) != (self.key is None):
            has, lacks = ("certificate", "key") if self.key is None else ("key", "certificate")
            raise ConfigError(
                f"there is a {has} and no {lacks}; one is of no use without the other", path=lacks
            )
        if self.certificate is not None and self.ca is None:
            raise ConfigError(
                "there is a certificate and no ca; say with whose certificate (ca.pem) others are checked",
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
        """What ``zstate certs`` wrote for ``name``. Raises ConfigError naming those that are there."""
        files = CertificateFiles.for_name(folder, name)
        if len(files.existing) < 2:
            names = sorted({path.stem for path in Path(folder).glob("*.pem")} - {AUTHORITY})
            there = f"the identities there are {', '.join(map(repr, names))}" if names else "there are none"
            raise ConfigError(
                f"{str(folder)!r} has no identity {name!r} ({files.certificate.name} and {files.key.name}); "
                f"{there}; `zstate certs {folder} --identity {name}` makes one for tests",
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
        """Whom others take this session for, in words; empty where it only knows whom to trust."""
        shown = [f"user {self.user!r}"] if self.user else []
        if self.certificate is not None:
            shown.append(f"the certificate {str(self.certificate)!r}")
        return " with ".join(shown)

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

    def settings(self) -> dict[str, object]:
        """What Zenoh is told of them, by the path in its configuration."""
        told: dict[str, object] = {}
        if self.ca is not None:
            told["transport/link/tls"] = self._tls()
        users = {"user": self.user, "password": self.password, "dictionary_file": _path(self.users)}
        if any(users.values()):
            told["transport/auth/usrpwd"] = {
                name: value for name, value in users.items() if value is not None
            }
        return told

    def _tls(self) -> dict[str, object]:
        # Names are checked always, or every identity of the authority could pose as the router.
        told: dict[str, object] = {"root_ca_certificate": _path(self.ca), "verify_name_on_connect": True}
        if self.certificate is None:
            return told
        pair = {"certificate": _path(self.certificate), "private_key": _path(self.key)}
        told |= {f"{side}_{name}": value for side in ("listen", "connect") for name, value in pair.items()}
        return {**told, "enable_mtls": True}


def _path(path: File | None) -> str | None:
    return None if path is None else str(Path(path).absolute())
