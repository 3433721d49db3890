from __future__ import annotations

import os
import ssl
import stat
import subprocess
import sys
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from zstate.errors import ConfigError, InvalidInput
from zstate.fleet.certificates import issue_identities

x509 = pytest.importorskip("cryptography.x509", reason="needs cryptography: pip install 'zstate[certs]'")


def read(path: Path):
    return x509.load_pem_x509_certificate(path.read_bytes())


def handshake(folder: Path, server: str, client: str, host: str) -> str | None:
    """The common name that ``server`` sees when ``client`` connects to it as ``host``, without a network."""
    ours, theirs = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    ours.verify_mode = ssl.CERT_REQUIRED
    for context, name in ((ours, server), (theirs, client)):
        context.load_verify_locations(folder / "ca.pem")
        context.load_cert_chain(folder / f"{name}.pem", folder / f"{name}.key")
    up, down = ssl.MemoryBIO(), ssl.MemoryBIO()
    listening = ours.wrap_bio(up, down, server_side=True)
    client_and_server = [theirs.wrap_bio(down, up, server_hostname=host), listening]
    for end in client_and_server * 3:
        with suppress(ssl.SSLWantReadError):
            end.do_handshake()
    certificate = listening.getpeercert()
    return dict(pair for (pair,) in certificate["subject"])["commonName"] if certificate else None


def test_identities_of_one_folder_trust_each_other_by_name_and_at_this_host(tmp_path: Path):
    issue_identities(tmp_path, ["router", "r1"])
    for host in ("localhost", "127.0.0.1", "::1"):
        assert handshake(tmp_path, "router", "r1", host) == "r1"


def test_certificate_is_valid_for_the_given_hosts_only(tmp_path: Path):
    issue_identities(tmp_path, ["router", "r1"], hosts=["10.0.0.7", "fleet.example"])
    for host in ("10.0.0.7", "fleet.example"):
        assert handshake(tmp_path, "router", "r1", host) == "r1"
    for host in ("10.0.0.8", "other.example"):
        with pytest.raises(ssl.SSLCertVerificationError):
            handshake(tmp_path, "router", "r1", host)


def test_second_call_uses_the_existing_authority(tmp_path: Path):
    issue_identities(tmp_path, ["router"])
    authority = (tmp_path / "ca.pem").read_bytes()
    issue_identities(tmp_path, ["r1"])
    assert (tmp_path / "ca.pem").read_bytes() == authority
    assert handshake(tmp_path, "router", "r1", "localhost") == "r1"


def test_keys_are_readable_by_their_owner_only(tmp_path: Path):
    was = os.umask(0)
    try:
        files = issue_identities(tmp_path / "fleet", ["r1"])["r1"]
    finally:
        os.umask(was)
    for key in (files.key, tmp_path / "fleet/ca.key"):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "fleet").stat().st_mode) == 0o700


def test_refused_call_overwrites_and_creates_no_file(tmp_path: Path):
    issue_identities(tmp_path, ["r1"])
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(InvalidInput, match=r"identity 'r1' already.*nothing is overwritten"):
        issue_identities(tmp_path, ["r2", "r1"])
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_certificate_is_valid_for_the_requested_days(tmp_path: Path):
    start = datetime(2026, 3, 1, tzinfo=UTC)
    files = issue_identities(tmp_path, ["r1"], days=30, valid_from=start)["r1"]
    certificate = read(files.certificate)
    assert certificate.not_valid_before_utc == start
    assert certificate.not_valid_after_utc == start + timedelta(days=30)


def test_a_certificate_begins_an_hour_ago_for_machines_whose_clocks_are_behind(tmp_path: Path):
    before = datetime.now(UTC)
    certificate = read(issue_identities(tmp_path, ["r1"], days=1)["r1"].certificate)
    # certificates count whole seconds
    assert certificate.not_valid_before_utc <= before - timedelta(minutes=59)
    assert certificate.not_valid_after_utc - certificate.not_valid_before_utc == timedelta(days=1, hours=1)


def test_certificate_cannot_outlive_its_authority(tmp_path: Path):
    with pytest.raises(InvalidInput, match="the authority is valid until"):
        issue_identities(tmp_path, ["r1"], days=10_000)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"names": ["ca"]}, "'ca' cannot be the name"),
        ({"names": ["../r1"]}, "'../r1' cannot be the name"),
        ({"names": [""]}, "'' cannot be the name"),
        ({"names": ["r" * 65]}, "up to 64"),
        ({"names": ["r1", "r1"]}, "'r1' is named twice"),
        ({"names": ["r1"], "hosts": ["tcp/10.0.0.1:7447"]}, "without protocol and port"),
        ({"names": ["r1"], "days": 0}, "days is 0"),
    ],
)
def test_invalid_arguments_create_no_file(tmp_path: Path, arguments, text: str):
    with pytest.raises(InvalidInput) as caught:
        issue_identities(tmp_path / "fleet", **arguments)
    assert text in str(caught.value)
    assert not (tmp_path / "fleet").exists()


def test_incomplete_or_foreign_authority_is_named(tmp_path: Path):
    issue_identities(tmp_path, ["r1"])
    key = (tmp_path / "ca.key").read_bytes()
    (tmp_path / "ca.key").unlink()
    with pytest.raises(ConfigError, match=r"ca\.key' is missing next to .*ca\.pem"):
        issue_identities(tmp_path, ["r2"])
    (tmp_path / "ca.key").write_bytes((tmp_path / "r1.key").read_bytes())
    with pytest.raises(ConfigError, match="is not the key"):
        issue_identities(tmp_path, ["r2"])
    (tmp_path / "ca.key").write_bytes(key[:50])
    with pytest.raises(ConfigError, match="cannot be read"):
        issue_identities(tmp_path, ["r2"])


def test_missing_library_error_has_the_install_command():
    code = (
        "import sys; sys.modules['cryptography'] = None\n"
        "from zstate.errors import LibraryMissing\n"
        "try: import zstate.fleet.certificates\n"
        "except LibraryMissing as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install 'zstate[certs]'" in done.stdout
