"""Certificate authority for tests (`zstate certs`): issues certificates and keys as files of one folder."""

from __future__ import annotations

import ipaddress
import os
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from zstate.errors import ConfigError, InvalidInput, LibraryMissing
from zstate.net.security.credentials import AUTHORITY, CertificateFiles, check_identity

THIS_HOST = ("localhost", "127.0.0.1", "::1")

_CLOCK_DIFFERENCE = timedelta(hours=1)  # a machine whose clock is behind accepts a new certificate, too
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
    """Issues certificates for ``names``, by the authority in ``folder``, which is created if missing.

    The name is the common name, the identity for access control. Certificates of ``servers`` (default: all)
    are valid for listening, too, at this host's loopback addresses and at ``hosts`` (names or IP addresses);
    the others are for clients and cannot pose as a router. All are valid for ``days`` from ``valid_from``
    (an aware time; default: now). Keys are readable by their owner only. No file is ever overwritten.

    Raises InvalidInput before any file is written, ConfigError for an unusable authority and files that
    cannot be written. Importing this module raises LibraryMissing without ``cryptography``.
    """
    for name in names:
        check_identity(name, reserved=AUTHORITY)
        if names.count(name) > 1:
            raise InvalidInput(f"the identity {name!r} is named twice")
    for host in hosts:
        if not _is_address(host) and not _HOST_NAME.fullmatch(host):
            raise InvalidInput(
                f"{host!r} is neither a host name nor an IP address; give it without protocol and port"
            )
    if days < 1:
        raise InvalidInput(f"days is {days}; a certificate is valid for one day at least")
    issued = {name: CertificateFiles.for_name(folder, name) for name in names}
    for name, files in issued.items():
        if files.existing:
            existing = " and ".join(repr(str(path)) for path in files.existing)
            raise InvalidInput(
                f"there is an identity {name!r} already: {existing}; nothing is overwritten: choose another "
                "name, or remove these files to replace it"
            )
    start = valid_from or datetime.now(UTC)
    first, last = start - (timedelta() if valid_from else _CLOCK_DIFFERENCE), start + timedelta(days=days)
    authority = CertificateAuthority.in_folder(Path(folder))
    authority.check_outlives(last)
    for name, files in issued.items():
        is_server = servers is None or name in servers
        authority.issue(name, files, (*THIS_HOST, *hosts) if is_server else (), (first, last))
    return issued


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


try:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import (
        Encoding,
        NoEncryption,
        PrivateFormat,
        load_pem_private_key,
    )
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError as error:
    raise LibraryMissing(
        f"making certificates needs the cryptography library ({error}): pip install 'zstate[certs]'"
    ) from None

AUTHORITY_DAYS = 3650
Validity = tuple[datetime, datetime]


@dataclass(frozen=True, slots=True)
class CertificateAuthority:
    """Signs identities with ``key``; sessions that trust ``certificate`` trust these."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    @classmethod
    def in_folder(cls, folder: Path) -> CertificateAuthority:
        """The authority in ``folder``, or a new one. Raises ConfigError if its files are not both usable."""
        files = CertificateFiles.for_name(folder, AUTHORITY)
        if not files.existing:
            return cls._create(folder, files)
        if len(files.existing) == 1:
            missing = files.key if files.certificate.exists() else files.certificate
            raise ConfigError(
                f"{str(missing)!r} is missing next to {str(files.existing[0])!r}; an authority needs both "
                "files: use the folder in which it was made, or a new one",
                path=str(missing),
            )
        try:
            certificate = x509.load_pem_x509_certificate(files.certificate.read_bytes())
            key = load_pem_private_key(files.key.read_bytes(), None)
        except (OSError, ValueError, TypeError) as error:
            raise ConfigError(
                f"the authority in {str(files.key.parent)!r} cannot be read: {error}", path=str(files.key)
            ) from None
        if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
            raise ConfigError(
                f"{str(files.key)!r} is not the key that `zstate certs` made for {str(files.certificate)!r}",
                path=str(files.key),
            )
        return cls(certificate, key)

    @classmethod
    def _create(cls, folder: Path, files: CertificateFiles) -> CertificateAuthority:
        # A unique name: two authorities of one name look like one with a bad signature.
        name = f"zstate test authority {os.urandom(4).hex()}"
        key = _new_key()
        now = datetime.now(UTC)
        # From long ago: tests need certificates of the past.
        valid = (now - timedelta(days=AUTHORITY_DAYS), now + timedelta(days=AUTHORITY_DAYS))
        builder = (
            _builder(name, key, valid)
            .issuer_name(_named(name))
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(signs_certificates=True), critical=True)
        )
        authority = cls(builder.sign(key, hashes.SHA256()), key)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _write(files, key, authority.certificate)
        return authority

    def check_outlives(self, last: datetime) -> None:
        """Raise InvalidInput if a certificate valid until ``last`` were valid longer than this authority."""
        until = self.certificate.not_valid_after_utc
        if last > until:
            raise InvalidInput(
                f"the authority is valid until {until:%Y-%m-%d}, which is before {last:%Y-%m-%d}; ask for "
                "fewer days, or use a new folder"
            )

    def issue(self, name: str, files: CertificateFiles, hosts: Iterable[str], valid: Validity) -> None:
        """Write a key and a certificate for ``name``: for clients, and for listening at ``hosts``, if any."""
        key = _new_key()
        issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key())
        names = [
            x509.IPAddress(ipaddress.ip_address(host)) if _is_address(host) else x509.DNSName(host)
            for host in dict.fromkeys(hosts)
        ]
        purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if names:
            purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
        builder = (
            _builder(name, key, valid)
            .issuer_name(self.certificate.subject)
            .add_extension(issuer, critical=False)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        )
        if names:
            builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        _write(files, key, builder.sign(self.key, hashes.SHA256()))


def _new_key() -> ec.EllipticCurvePrivateKey:
    return ec.generate_private_key(ec.SECP256R1())


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _builder(name: str, key: ec.EllipticCurvePrivateKey, valid: Validity) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(_named(name))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(valid[0])
        .not_valid_after(valid[1])
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _write(files: CertificateFiles, key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate) -> None:
    pem = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    _write_new(files.key, pem, 0o600)
    _write_new(files.certificate, certificate.public_bytes(Encoding.PEM), 0o644)


def _write_new(path: Path, content: bytes, mode: int) -> None:
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(content)
    except OSError as error:
        raise ConfigError(f"{str(path)!r} cannot be written: {error.strerror}", path=str(path)) from None
