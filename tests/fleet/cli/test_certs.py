"""Certificates made on the command line, and commands that show them, or a user, to a router."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, Spawn, failure, interrupted, run_cli, started
from helpers.processes import find_free_port
from helpers.programs import router

from zstate import connect
from zstate.errors import AccessDenied
from zstate.net.security.credentials import Credentials

pytest.importorskip("cryptography", reason="needs cryptography: pip install 'zstate[certs]'")


def test_certs_prints_its_files_and_a_warning(tmp_path: Path):
    folder = tmp_path / "fleet"
    done = run_cli("certs", str(folder), "--identity", "router", "--identity", "r1", "--host", "10.0.0.1")
    assert done.code == 0
    lines = done.stdout.splitlines()
    assert [line.partition(":")[0] for line in lines] == ["router", "r1"]
    assert str(folder / "r1.key") in lines[1]
    assert {path.name for path in folder.iterdir()} == {
        *("ca.pem", "ca.key"),
        *("router.pem", "router.key"),
        *("r1.pem", "r1.key"),
    }
    assert "These are for tests" in done.stderr
    assert "In production keep it off every robot" in done.stderr


def test_certs_adds_identities_and_never_overwrites(tmp_path: Path):
    assert run_cli("certs", str(tmp_path), "--identity", "router").code == 0
    assert run_cli("certs", str(tmp_path), "--identity", "r1").code == 0
    assert "nothing is overwritten" in failure("certs", str(tmp_path), "--identity", "r1")
    assert "--identity" in failure("certs", str(tmp_path), code=2)
    assert "--days" in failure("certs", str(tmp_path), "--identity", "r2", "--days", "0", code=2)


@pytest.mark.processes
def test_commands_with_identities_connect_through_a_router_that_requires_them(
    spawn: Spawn, tmp_path: Path, free_port: int
):
    folder = str(tmp_path)
    run_cli("certs", folder, *("--identity", "router"), *("--identity", "r1"), *("--identity", "viewer"))
    endpoint = f"tls/127.0.0.1:{free_port}"
    required = started(spawn, "router", "--listen", endpoint, "--certs", folder, "--identity", "router")
    assert endpoint in required.line()
    robot = ("--connect", endpoint, "--certs", folder, "--identity", "r1")
    started(spawn, "publish", RRBOT, "--source", "sine", *robot).line()
    viewer = ("--connect", endpoint, "--certs", folder, "--identity", "viewer")
    done = run_cli("tf", "base", "lower", "--once", *viewer)
    assert done.code == 0, done.stderr
    interrupted(required)


def test_a_password_comes_from_the_environment_or_a_file(
    tmp_path: Path, free_port: int, monkeypatch: pytest.MonkeyPatch
):
    users, password = tmp_path / "users", tmp_path / "password"
    for file, text in ((users, "alice:wonder\n"), (password, "wonder\n")):
        file.touch(0o600)
        file.write_text(text)
    with router(f"tcp/127.0.0.1:{free_port}", users=users) as endpoint:
        alice = ("ls", "--connect", endpoint, "--user", "alice")
        assert "ZSTATE_PASSWORD" in failure(*alice, code=2)
        assert run_cli(*alice, "--password-file", str(password)).code == 0
        password.chmod(0o644)
        assert "chmod 600" in failure(*alice, "--password-file", str(password))
        monkeypatch.setenv("ZSTATE_PASSWORD", "wander")
        assert "the user 'alice' or the password" in failure(*alice)
        monkeypatch.setenv("ZSTATE_PASSWORD", "wonder")
        assert run_cli(*alice).code == 0


@pytest.mark.parametrize(
    ("options", "hint"),
    [
        (("--certs", "."), "--identity NAME"),
        (("--identity", "r1"), "--certs DIR"),
        (("--password-file", __file__), "--user NAME"),
    ],
)
def test_half_an_identity_is_wrong_usage(options: tuple[str, ...], hint: str):
    assert hint in failure("ls", *options, code=2)


def test_a_router_that_listens_unencrypted_with_certificates_is_refused(tmp_path: Path):
    run_cli("certs", str(tmp_path), "--identity", "router")
    identity = ("--certs", str(tmp_path), "--identity", "router")
    assert "write 'tls/0.0.0.0:7447'" in failure("router", "--listen", "tcp/0.0.0.0:7447", *identity)
    assert "needs a certificate" in failure("router", "--listen", "tls/0.0.0.0:7447")
    assert "'tls/127.0.0.1:7447'" in run_cli("router", "--print", *identity).stdout.replace('"', "'")


def test_only_server_certificates_can_listen(tmp_path):
    folder = str(tmp_path / "pki")
    assert run_cli("certs", folder, "--identity", "router", "--identity", "r1", "--server", "peer").code == 0
    router, peer, r1 = (Credentials.from_folder(folder, name) for name in ("router", "peer", "r1"))
    for credentials in (router, peer):
        endpoint = f"tls/127.0.0.1:{find_free_port()}"
        with (
            connect(mode="router", listen=endpoint, credentials=credentials),
            connect(mode="client", endpoints=endpoint, credentials=r1) as client,
        ):
            assert list(client.zenoh.info.routers_zid())
    endpoint = f"tls/127.0.0.1:{find_free_port()}"
    with (
        connect(mode="router", listen=endpoint, credentials=r1),
        pytest.raises(AccessDenied, match="is for clients only") as caught,
    ):
        connect(mode="client", endpoints=endpoint, credentials=peer, timeout_s=0.2)
    assert caught.value.reason == "not a server"


def test_host_needs_a_server_identity(tmp_path):
    folder = str(tmp_path / "pki")
    assert "--host needs an identity that listens" in failure(
        "certs", folder, "--identity", "r1", "--host", "10.0.0.1", code=2
    )
    assert "no identity is named" in failure("certs", folder, code=2)
