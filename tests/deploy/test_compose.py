from __future__ import annotations

from typing import Any

import pytest
import zenoh
from helpers.cli_runner import Command, run_watched
from helpers.deployment import DEPLOY, Deployment
from helpers.processes import until

from zstate import StatePublisher, connect, discover, load_model
from zstate.errors import AccessDenied
from zstate.net.security.credentials import Credentials


@pytest.mark.long
@pytest.mark.processes
def test_reader_of_the_compose_file_receives_its_moving_robot(deployment: Deployment, spawn: Any):
    deployment.start_router(spawn).line()
    deployment.start(spawn, "robot").line()
    until(lambda: deployment.is_healthy("robot"))
    until(lambda: deployment.is_healthy("reader"))
    assert "r1" in deployment.start(spawn, "reader").line()


def test_health_checks_fail_without_router_and_without_robot(deployment: Deployment):
    assert not deployment.is_healthy("robot")
    with connect(str(deployment.router_file)):
        assert not deployment.is_healthy("reader")


def test_compose_router_refuses_writes_of_other_identities(deployment: Deployment):
    endpoint = f"tls/localhost:{deployment.port}"

    def join(name: str) -> Any:
        credentials = Credentials.from_folder(deployment.certs, name)
        return connect(mode="client", endpoints=endpoint, credentials=credentials)

    def write(router: Command) -> None:
        router.line()
        model = load_model("rrbot")
        with join("r1") as robot, join("r2") as other, join("desk") as viewer:
            for session in (other, viewer):
                with pytest.raises(AccessDenied, match="'r1 writes'"):
                    StatePublisher(session, model, "r1")
            with StatePublisher(robot, model, "r1"):
                until(lambda: [info.name for info in discover(viewer)] == ["r1"])
                assert discover(other, 0.3) == ()  # r2 has a certificate, but no rule

    run_watched(write, "router", "--config", str(deployment.router_file))


def test_client_without_certificate_is_refused(deployment: Deployment):
    def join(router: Command) -> None:
        router.line()
        ca = Credentials(ca=deployment.certs / "ca.pem")
        with pytest.raises(AccessDenied, match="requires a certificate"):
            connect(mode="client", endpoints=f"tls/localhost:{deployment.port}", credentials=ca)

    run_watched(join, "router", "--config", str(deployment.router_file))


def test_every_service_restarts_and_waits_for_the_router(deployment: Deployment):
    for name, service in deployment.services.items():
        assert service["restart"] == "unless-stopped"
        if name != "router":
            assert service["depends_on"]["router"]["condition"] == "service_healthy"
            assert service["build"] == ".."


def test_each_container_has_only_its_own_key(deployment: Deployment):
    for name, service in deployment.services.items():
        identity = service.get("environment", {}).get("ZSTATE_IDENTITY", "router")
        keys = [volume for volume in service["volumes"] if volume.split(":")[0].endswith(".key")]
        assert keys == [f"./certs/{identity}.key:/certs/{identity}.key:ro"], name
        assert all(volume.endswith(":ro") for volume in service["volumes"])


@pytest.mark.parametrize("name", ["router.json5", "site-router.json5"])
def test_zenoh_accepts_every_configuration(name: str):
    zenoh.Config.from_json5((DEPLOY / name).read_text())
