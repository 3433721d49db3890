"""Configurations of Zenoh that a user gives: a file, a mapping or a zenoh.Config."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import zenoh

from zstate.errors import ConfigError
from zstate.net.config import ADDRESSED, LOCAL, ConfigSource, Mode, apply_settings, mode_settings

if TYPE_CHECKING:
    from zstate.net.security.credentials import Credentials


def user_config(
    source: ConfigSource,
    mode: Mode,
    endpoints: Sequence[str],
    listen: Sequence[str],
    credentials: Credentials | None = None,
) -> zenoh.Config:
    """The user's configuration, with credentials, endpoints and a mode other than "peer" replaced."""
    settings = {
        **({} if mode == "peer" else mode_settings(mode)),
        **(credentials.settings() if credentials else {}),
    }
    if endpoints:
        settings["connect/endpoints"] = list(endpoints)
    if listen:
        settings["listen/endpoints"] = list(listen)
    return apply_settings(_load(source), settings)


def endpoints_in(config: zenoh.Config) -> tuple[str, ...]:
    """The endpoints that ``config`` connects to; empty unless they are a plain list."""
    found = json.loads(config.get_json("connect/endpoints"))
    return tuple(e for e in found if isinstance(e, str)) if isinstance(found, list) else ()  # pyright: ignore[reportUnknownVariableType]


def credentials_in(config: zenoh.Config) -> Credentials | None:
    """The credentials in ``config``; None if it has none, or of a kind that ``connect`` does not accept."""
    tls: dict[str, Any] = json.loads(config.get_json("transport/link/tls"))
    user: dict[str, Any] = json.loads(config.get_json("transport/auth/usrpwd"))
    found = {
        "user": user["user"],
        "password": user["password"],
        "ca": tls["root_ca_certificate"],
        "certificate": tls["connect_certificate"],
        "key": tls["connect_private_key"],
    }
    if not any(found.values()):
        return None
    from zstate.net.security.credentials import Credentials  # noqa: PLC0415  # most sessions have none

    try:
        return Credentials(**found)
    except ConfigError:
        return None


def _load(source: ConfigSource) -> zenoh.Config:
    if isinstance(source, zenoh.Config):
        return zenoh.Config.from_json5(str(source))
    if isinstance(source, Mapping):
        return _parse(json.dumps(dict(source)), "the configuration given")
    path = Path(source)
    if (text := str(path)).partition("/")[0] in ADDRESSED | LOCAL and not path.exists():
        error = f"{text!r} is an endpoint, not a file: connect(mode='client', endpoints={text!r})"
        raise ConfigError(error, path=text)
    try:
        return _parse(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        text = f"the Zenoh configuration {str(path)!r} cannot be read: {error}"
        raise ConfigError(text, path=str(path)) from None


def _parse(text: str, name: str) -> zenoh.Config:
    try:
        return zenoh.Config.from_json5(text)
    except zenoh.ZError as error:
        raise ConfigError(f"{name!r} is not a Zenoh configuration: {error}", path=name) from None


# zenoh 1.10, a client spends all of connect/timeout_ms on its first endpoint, issue 1602: delete when fixed
def connect_timeout(config: zenoh.Config) -> float:
    """How long the client that ``config`` describes retries [s]; clears that time in ``config``.

    Without it, Zenoh tries each endpoint once. 0 if ``config`` describes no client, or does not retry.
    """

    def client_value(name: str) -> Any:
        """A setting, or the client's part of it if it has a value for each mode."""
        value: Any = json.loads(config.get_json(f"connect/{name}"))
        return cast("dict[str, Any]", value).get("client") if isinstance(value, dict) else value

    timeout_ms, is_needed = client_value("timeout_ms"), client_value("exit_on_failure")
    is_client = json.loads(config.get_json("mode")) == "client"
    if not (is_client and endpoints_in(config) and timeout_ms) or is_needed is False:
        return 0.0
    config.insert_json5("connect/timeout_ms", "0")
    return math.inf if timeout_ms < 0 else timeout_ms / 1000.0
