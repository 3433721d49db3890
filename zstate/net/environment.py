"""The arguments of ``connect`` in the environment, for programs that give none."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from zstate.errors import ConfigError, InvalidInput, NetworkError, PortBusy
from zstate.net.config import (
    CONFIG_VARIABLE,
    CONNECT,
    FILE,
    LISTEN,
    MODE,
    Mode,
    check_loopback_only,
    check_mode,
    endpoint_list,
)

if TYPE_CHECKING:
    from zstate.net.security.credentials import Credentials

CERTS, IDENTITY = "ZSTATE_CERTS", "ZSTATE_IDENTITY"
USER, PASSWORD, PASSWORD_FILE = "ZSTATE_USER", "ZSTATE_PASSWORD", "ZSTATE_PASSWORD_FILE"

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """The arguments of ``connect``."""

    mode: Mode
    endpoints: tuple[str, ...]
    listen: tuple[str, ...]
    config: str | None
    credentials: Credentials | None


def settings_from_environment() -> SessionSettings | None:
    """The settings in ZSTATE_MODE, _CONNECT, _LISTEN and _CONFIG, with credentials; None if all are unset.

    Endpoints are separated by blanks. Raises ConfigError with the variable.
    """
    mode, config = os.environ.get(MODE), os.environ.get(FILE) or None
    endpoints, listen = _endpoints(CONNECT), _endpoints(LISTEN)
    if not (mode or endpoints or listen or config):
        return None
    checked: Mode = _checked(MODE, lambda: check_mode(mode or implied_mode(endpoints, listen, config)))
    if checked == "loopback":
        for variable, used in ((CONNECT, endpoints), (LISTEN, listen)):
            _checked(variable, lambda used=used: check_loopback_only(used))
    if checked == "client" and not (endpoints or config or os.environ.get(CONFIG_VARIABLE)):
        raise ConfigError(
            f"{MODE} is 'client' and {CONNECT} is not set; set it to the router's endpoint, for instance "
            "tcp/192.168.1.10:7447",
            path=MODE,
        )
    return SessionSettings(checked, endpoints, listen, config, _credentials_in_environment())


def implied_mode(endpoints: object, listen: object, config: object) -> str:
    """The mode if endpoints are set, but no mode."""
    # An endpoint to connect to is usually a router, and peers do not forward.
    return "client" if endpoints and not listen and not config else "peer"


@contextmanager
def blame_variable() -> Generator[None]:
    """Add the variable that holds the endpoint to network errors."""
    try:
        yield
    except NetworkError as error:
        variable = LISTEN if isinstance(error, PortBusy) else CONNECT
        if os.environ.get(variable):
            error.args = (f"{error} (the endpoint is from {variable} in the environment)",)
        raise


def _endpoints(variable: str) -> tuple[str, ...]:
    return _checked(variable, lambda: endpoint_list(os.environ.get(variable, "").split()))


def _checked(variable: str, check: Callable[[], T]) -> T:
    try:
        return check()
    except InvalidInput as error:
        raise ConfigError(f"{variable} in the environment: {error}", path=variable) from None


def _credentials_in_environment() -> Credentials | None:
    certs, identity, user = (os.environ.get(variable) for variable in (CERTS, IDENTITY, USER))
    if bool(certs) != bool(identity):
        has, lacks = (CERTS, IDENTITY) if certs else (IDENTITY, CERTS)
        raise ConfigError(f"{has} is set but {lacks} is not; set both or neither", path=has)
    if not (certs or user):
        return None
    from zstate.net.security.credentials import Credentials, password_in  # noqa: PLC0415  # as above

    password = os.environ.get(PASSWORD) if user else None
    if user and (file := os.environ.get(PASSWORD_FILE)):
        password = password_in(file)
    elif user and not password:
        raise ConfigError(
            f"the password of {user!r} ({USER} in the environment) is missing; put it into {PASSWORD}, or "
            f"the path of its file into {PASSWORD_FILE}",
            path=PASSWORD,
        )
    if certs and identity:
        return Credentials.from_folder(certs, identity, user=user or None, password=password)
    return Credentials(user=user, password=password)
