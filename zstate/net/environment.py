"""What the environment says about joining the network: what zstate's commands go by, for other programs."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from zstate.errors import ConfigError, InvalidInput, NetworkError, PortBusy
from zstate.net.config import CONFIG_VARIABLE, Mode, endpoint_list
from zstate.net.modes import check_mode, check_stays_here
from zstate.net.security import Credentials

MODE, CONNECT, LISTEN, FILE = "ZSTATE_MODE", "ZSTATE_CONNECT", "ZSTATE_LISTEN", "ZSTATE_CONFIG"
CERTS, IDENTITY = "ZSTATE_CERTS", "ZSTATE_IDENTITY"
USER, PASSWORD, PASSWORD_FILE = "ZSTATE_USER", "ZSTATE_PASSWORD", "ZSTATE_PASSWORD_FILE"

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Said:
    """How to join, as ``connect`` takes it."""

    mode: Mode
    endpoints: tuple[str, ...]
    listen: tuple[str, ...]
    config: str | None
    credentials: Credentials | None


def said_in_environment() -> Said | None:
    """What ZSTATE_MODE, _CONNECT, _LISTEN and _CONFIG say, and who this is; None where they say nothing.

    Endpoints stand with blanks between them. Raises ConfigError naming the variable.
    """
    mode, config = os.environ.get(MODE), os.environ.get(FILE) or None
    endpoints, listen = _endpoints(CONNECT), _endpoints(LISTEN)
    if not (mode or endpoints or listen or config):
        return None
    checked: Mode = _checked(MODE, lambda: check_mode(mode or implied_mode(endpoints, listen, config)))
    if checked == "loopback":
        for variable, said in ((CONNECT, endpoints), (LISTEN, listen)):
            _checked(variable, lambda said=said: check_stays_here(said))
    if checked == "client" and not (endpoints or config or os.environ.get(CONFIG_VARIABLE)):
        raise ConfigError(
            f"{MODE} is 'client', and {CONNECT} does not say where the router is, for instance "
            "tcp/192.168.1.10:7447",
            path=MODE,
        )
    return Said(checked, endpoints, listen, config, _credentials())


def implied_mode(endpoints: object, listen: object, config: object) -> str:
    """What is meant by whoever names places and no mode."""
    # Whoever only says where to connect means a router, and peers do not pass on what others say.
    return "client" if endpoints and not listen and not config else "peer"


@contextmanager
def naming_the_variable() -> Generator[None]:
    """Let an error of the network name the variable that sent us there."""
    try:
        yield
    except NetworkError as error:
        variable = LISTEN if isinstance(error, PortBusy) else CONNECT
        if os.environ.get(variable):
            error.args = (f"{error} ({variable} in the environment says where)",)
        raise


def _endpoints(variable: str) -> tuple[str, ...]:
    return _checked(variable, lambda: endpoint_list(os.environ.get(variable, "").split()))


def _checked(variable: str, check: Callable[[], T]) -> T:
    try:
        return check()
    except InvalidInput as error:
        raise ConfigError(f"{variable} in the environment: {error}", path=variable) from None


def _credentials() -> Credentials | None:
    certs, identity, user = (os.environ.get(variable) for variable in (CERTS, IDENTITY, USER))
    if bool(certs) != bool(identity):
        has, lacks = (CERTS, IDENTITY) if certs else (IDENTITY, CERTS)
        raise ConfigError(f"{has} in the environment is of no use without {lacks}", path=has)
    password = _password(user) if user else None
    if certs and identity:
        return Credentials.from_folder(certs, identity, user=user or None, password=password)
    return Credentials(user=user, password=password) if user else None


def _password(user: str) -> str:
    file, password = os.environ.get(PASSWORD_FILE), os.environ.get(PASSWORD)
    if file:
        from zstate.net.credential_files import password_in  # noqa: PLC0415  # loads ssl, which few need

        return password_in(file)
    if not password:
        raise ConfigError(
            f"the password of {user!r} ({USER} in the environment) is missing; put it into {PASSWORD}, or "
            f"where it stands into {PASSWORD_FILE}",
            path=PASSWORD,
        )
    return password
