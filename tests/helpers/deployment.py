"""The services of deploy/ on one host: localhost in place of names, at a free port."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from helpers.cli_runner import run_cli
from helpers.processes import Child, find_free_port
from ruamel.yaml import YAML

DEPLOY = Path(__file__).parents[2] / "deploy"


class Deployment:
    """The services of compose.yaml, with certificates in ``folder``."""

    def __init__(self, folder: Path) -> None:
        self.certs = folder / "certs"
        self.port = find_free_port()
        self.services: dict[str, Any] = YAML(typ="safe").load(DEPLOY / "compose.yaml")["services"]
        self.router_file = folder / "router.json5"
        self.router_file.write_text(self.localized((DEPLOY / "router.json5").read_text()))

    def localized(self, text: str) -> str:
        """``text`` with the addresses and paths of this host."""
        for original, local in {
            "tls/router:7447": f"tls/localhost:{self.port}",
            "tls/0.0.0.0:7447": f"tls/127.0.0.1:{self.port}",
            '"/certs/': f'"{self.certs}/',
        }.items():
            text = text.replace(original, local)
        return str(self.certs) if text == "/certs" else text

    def environment(self, service: str) -> dict[str, str]:
        variables = self.services[service].get("environment", {})
        return {name: self.localized(value) for name, value in variables.items()}

    def start(self, spawn: Any, service: str) -> Child:
        """Starts the command of the container of ``service``."""
        setup = f"import os; os.environ.update({self.environment(service)!r})"
        code = f"{setup}; from zstate.cli.main import main; main()"
        return spawn(code, *self.services[service]["command"])

    def start_router(self, spawn: Any) -> Child:
        return spawn("from zstate.cli.main import main; main()", "router", "--config", str(self.router_file))

    def is_healthy(self, service: str) -> bool:
        """Whether the health check of ``service`` passes."""
        kind, program, *arguments = self.services[service]["healthcheck"]["test"]
        assert (kind, program) == ("CMD", "zstate")
        with pytest.MonkeyPatch.context() as container:
            for name, value in self.environment(service).items():
                container.setenv(name, value)
            ended = run_cli(*arguments)
        assert "Traceback" not in ended.stderr
        return ended.code == 0
