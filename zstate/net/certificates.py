"""Identities for tests: a certificate and a key for each, as files of one folder."""

from __future__ import annotations

import ipaddress
import os
import re
from collections.abc import Collection, Sequence
from datetime import datetime, timedelta, timezone
from pathlib import Path

from zstate.errors import InvalidInput
from zstate.net.security import AUTHORITY, CertificateFiles

THIS_HOST = ("localhost", "127.0.0.1", "::1")

_CLOCKS_DIFFER_BY = timedelta(hours=1)  # a machine whose clock is behind takes a new certificate, too
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")  # a common name has 64 characters at most
_HOST_NAME = re.compile(r"(\*\.)?[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?")


def issue_identities(
    folder: str | os.PathLike[str],
    names: Sequence[str],
    *,
    hosts: Sequence[str] = (),
    servers: Collection[str] | None = None,
    days: int = 365,
    valid_from: datetime | None = None,
) -> dict[str, CertificateFiles]:
    """Certificates for ``names``, by the authority in ``folder``, which is made if there is none.

    The common name of each is its name, which is how access control knows it. Those of ``servers``
    (all unless given) serve to listen, too, at this host's loopback addresses and at ``hosts`` (names
    or IP addresses); the others serve to connect and cannot pose as a router. All are valid for
    ``days`` from ``valid_from`` (an aware time; now unless given). Keys are readable by their owner
    only. No file is ever overwritten.

    Raises InvalidInput before anything is written, ConfigError for an authority that cannot be used
    and files that cannot be written, LibraryMissing without ``cryptography``.
    """
    _check(names, hosts, days)
    issued = {name: CertificateFiles.of(folder, name) for name in names}
    for name, files in issued.items():
        _refuse_existing(name, files)

    from zstate.net.authority import Authority  # noqa: PLC0415  # needs cryptography, an extra

    start = valid_from or datetime.now(timezone.utc)
    first, last = start - (timedelta() if valid_from else _CLOCKS_DIFFER_BY), start + timedelta(days=days)
    authority = Authority.in_folder(Path(folder))
    authority.check_outlives(last)
    for name, files in issued.items():
        is_server = servers is None or name in servers
        authority.issue(name, files, (*THIS_HOST, *hosts) if is_server else (), (first, last))
    return issued


def _check(names: Sequence[str], hosts: Sequence[str], days: int) -> None:
    for name in names:
        if not _NAME.fullmatch(name) or name == AUTHORITY:
            raise InvalidInput(
                f"{name!r} cannot be the name of an identity; use up to 64 of A-Z a-z 0-9 . _ -, beginning "
                f"with a letter or digit, and not {AUTHORITY!r}"
            )
        if names.count(name) > 1:
            raise InvalidInput(f"the identity {name!r} is named twice")
    for host in hosts:
        if not _is_address(host) and not _HOST_NAME.fullmatch(host):
            raise InvalidInput(
                f"{host!r} is neither a host name nor an IP address; give it without protocol and port"
            )
    if days < 1:
        raise InvalidInput(f"days is {days}; a certificate is valid for one day at least")


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _refuse_existing(name: str, files: CertificateFiles) -> None:
    if files.existing:
        there = " and ".join(repr(str(path)) for path in files.existing)
        raise InvalidInput(
            f"there is an identity {name!r} already: {there}; nothing is overwritten: choose another name, "
            "or remove what is there to replace it"
        )
