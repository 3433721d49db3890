from __future__ import annotations

from pathlib import Path

import pytest

from zstate.errors import ConfigError
from zstate.fleet.certificates import issue_identities
from zstate.net.security.credentials import Credentials
from zstate.net.session import connect

HERE = "tls/127.0.0.1:1"


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the identities r1 and r2."""
    pytest.importorskip("cryptography", reason="needs cryptography: pip install 'zstate[certs]'")
    folder = tmp_path_factory.mktemp("fleet")
    issue_identities(folder, ["r1", "r2"])
    return folder


def refusal(credentials: Credentials, **arguments: object) -> str:
    with pytest.raises(ConfigError) as caught:
        connect(credentials=credentials, **{"mode": "client", "endpoints": HERE, **arguments})
    return str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({}, "are empty"),
        ({"user": "alice"}, "a user and no password"),
        ({"password": "x"}, "a password and no user"),
        ({"user": "", "password": "x"}, "not empty"),
        ({"user": "a:b", "password": "x"}, "no ':'"),
        ({"ca": "ca.pem", "certificate": "r1.pem"}, "a certificate and no key"),
        ({"ca": "ca.pem", "key": "r1.key"}, "a key and no certificate"),
        ({"certificate": "r1.pem", "key": "r1.key"}, "a certificate and no ca"),
    ],
)
def test_incomplete_credentials_name_the_missing_part(arguments: dict[str, str], text: str):
    with pytest.raises(ConfigError) as caught:
        Credentials(**arguments)
    assert text in str(caught.value)


def test_repr_of_credentials_has_no_password():
    assert "wonder" not in repr(Credentials(user="alice", password="wonder"))


def test_missing_identity_error_lists_existing_ones(fleet: Path):
    assert Credentials.from_folder(fleet, "r1").certificate == fleet / "r1.pem"
    with pytest.raises(ConfigError, match=r"no identity 'r3'.*are 'r1', 'r2'; .*zstate certs"):
        Credentials.from_folder(fleet, "r3")
    with pytest.raises(ConfigError, match="it has none"):
        Credentials.from_folder(fleet / "elsewhere", "r1")


def test_unencrypted_endpoint_is_refused_with_certificates(fleet: Path):
    text = refusal(Credentials.from_folder(fleet, "r1"), endpoints="tcp/10.0.0.1:7447")
    assert "'tcp/10.0.0.1:7447' is not encrypted" in text
    assert "write 'tls/10.0.0.1:7447'" in text


def test_listening_with_encryption_needs_a_certificate(fleet: Path):
    text = refusal(Credentials(ca=fleet / "ca.pem"), mode="router", endpoints=(), listen=HERE)
    assert f"listening at '{HERE}' needs a certificate" in text
    with pytest.raises(ConfigError, match="needs a certificate"):
        connect(mode="router", listen=HERE)


def test_router_with_a_user_and_no_users_file_is_refused():
    text = refusal(Credentials(user="alice", password="x"), mode="router", endpoints=())
    assert "refuses every connection" in text


def test_rendezvous_of_one_host_needs_no_credentials():
    for mode in ("peer", "loopback"):
        assert "endpoints=" in refusal(Credentials(user="a", password="b"), mode=mode, endpoints=())


def test_missing_files_are_named(fleet: Path):
    for part in ("ca", "certificate", "key"):
        files = {"ca": fleet / "ca.pem", "certificate": fleet / "r1.pem", "key": fleet / "r1.key"}
        text = refusal(Credentials(**{**files, part: fleet / "nothing"}))
        assert "nothing' cannot be read: No such file" in text


def test_malformed_files_are_named(fleet: Path, tmp_path: Path):
    other = tmp_path / "other"
    other.write_text("hello")
    other.chmod(0o600)
    assert "holds no certificate" in refusal(Credentials(ca=other))
    ca, certificate = fleet / "ca.pem", fleet / "r1.pem"
    text = refusal(Credentials(ca=ca, certificate=certificate, key=other))
    assert "other' are not a certificate and its unencrypted key" in text
    text = refusal(Credentials(ca=ca, certificate=certificate, key=fleet / "r2.key"))
    assert "do not belong together" in text


def test_encrypted_key_is_refused_without_a_prompt(fleet: Path, tmp_path: Path):
    serialization = pytest.importorskip("cryptography.hazmat.primitives.serialization")
    key = serialization.load_pem_private_key((fleet / "r1.key").read_bytes(), None)
    locked = tmp_path / "locked.key"
    encryption = serialization.BestAvailableEncryption(b"secret")
    locked.write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, encryption)
    )
    locked.chmod(0o600)
    text = refusal(Credentials(ca=fleet / "ca.pem", certificate=fleet / "r1.pem", key=locked))
    assert "unencrypted key" in text


def test_world_readable_secrets_are_refused(fleet: Path, tmp_path: Path):
    key, users = tmp_path / "r1.key", tmp_path / "users"
    key.write_bytes((fleet / "r1.key").read_bytes())
    users.write_text("alice:wonder\n")
    for secret in (key, users):
        secret.chmod(0o644)
    text = refusal(Credentials(ca=fleet / "ca.pem", certificate=fleet / "r1.pem", key=key))
    assert "mode 644" in text
    assert f"chmod 600 {key}" in text
    assert f"chmod 600 {users}" in refusal(Credentials(users=users), endpoints="tcp/127.0.0.1:1")


def test_unreadable_file_is_named(fleet: Path, tmp_path: Path):
    hidden = tmp_path / "ca.pem"
    hidden.mkdir()  # root reads every file
    assert str(hidden) in refusal(Credentials(ca=hidden))


@pytest.mark.parametrize(
    ("lines", "text"),
    [
        ("alice\n", "line 1: write user:password"),
        ("alice:wonder\n# viewer\n", "line 2: write user:password; comments"),
        ("alice:\n", "line 1: write user:password"),
        (":wonder\n", "line 1: write user:password"),
        ("alice:a\n\nbob:b\nalice:c\n", "line 4: the user 'alice' is already in line 1"),
        ("\n", "has no user"),
    ],
)
def test_users_file_that_zenoh_would_misread_is_refused_with_its_line(tmp_path: Path, lines: str, text: str):
    users = tmp_path / "users"
    users.write_text(lines)
    users.chmod(0o600)
    assert text in refusal(Credentials(users=users), mode="router", endpoints=())
