"""How what is started joins the network, as options of zstate and as the environment of other programs."""

from __future__ import annotations

from zstate.cli.up.cell import Cell
from zstate.cli.up.sections import NetworkSection, RouterSection
from zstate.cli.up.tables import Placed
from zstate.net.config import ROUTER_ENDPOINT

# The options and variables of one value, and their keys.
_SINGLE = {
    "mode": ("--mode", "ZSTATE_MODE"),
    "config": ("--config", "ZSTATE_CONFIG"),
    "certs": ("--certs", "ZSTATE_CERTS"),
    "identity": ("--identity", "ZSTATE_IDENTITY"),
    "user": ("--user", "ZSTATE_USER"),
    "password_file": ("--password-file", "ZSTATE_PASSWORD_FILE"),
}
_REPEATED = {"connect": ("--connect", "ZSTATE_CONNECT"), "listen": ("--listen", "ZSTATE_LISTEN")}
_PATHS = ("config", "certs", "password_file", "acl", "users")


def session_options(cell: Cell, identity: str | None = None) -> tuple[str, ...]:
    """The session options of [network], as ``identity`` where that is given.

    Without a place to connect to, what is started comes to the file's router.
    """
    single, repeated = _joining(cell, identity)
    return (
        *(part for key, value in single.items() for part in (_SINGLE[key][0], value)),
        *(part for key, values in repeated.items() for part in options(_REPEATED[key][0], values)),
    )


def session_variables(cell: Cell, identity: str | None = None) -> dict[str, str]:
    """The same for other programs, and for the commands of zstate among them."""
    single, repeated = _joining(cell, identity)
    variables = {_SINGLE[key][1]: value for key, value in single.items()}
    return variables | {_REPEATED[key][1]: " ".join(values) for key, values in repeated.items() if values}


def router_options(router: Placed[RouterSection]) -> tuple[str, ...]:
    """The options of `zstate router`."""
    section = router.section
    paths = {
        key: path for key in ("acl", "certs", "password_file", "users") if (path := getattr(section, key))
    }
    texts = {
        key: text for key in ("identity", "user", "metrics") if (text := getattr(section, key)) is not None
    }
    return (
        *(("--ros2",) if section.ros2 else ()),
        *options("--listen", _listening(section)),
        *options("--connect", section.connect),
        *(part for key, path in paths.items() for part in (_option(key), router.beside(path))),
        *(part for key, text in texts.items() for part in (_option(key), str(text))),
    )


def options(option: str, values: tuple[str, ...]) -> tuple[str, ...]:
    """``option`` once for each of ``values``."""
    return tuple(part for value in values for part in (option, value))


def _joining(cell: Cell, identity: str | None) -> tuple[dict[str, str], dict[str, tuple[str, ...]]]:
    network = NetworkSection() if cell.network is None else cell.network.section
    single = {key: str(value) for key in _SINGLE if (value := getattr(network, key)) is not None}
    repeated = {key: tuple(getattr(network, key)) for key in _REPEATED}
    if cell.network is not None:
        single |= {key: cell.network.beside(single[key]) for key in _PATHS if key in single}
    if identity is not None:
        single["identity"] = identity
    is_said = network.mode or network.connect or network.listen or network.config
    if cell.router is not None and not is_said:
        single["mode"] = "client"
        repeated["connect"] = (_reachable(_listening(cell.router.section)[0]),)
    if "certs" not in single:
        single.pop("identity", None)
    return single, repeated


def _listening(router: RouterSection) -> tuple[str, ...]:
    default = ROUTER_ENDPOINT if router.certs is None else ROUTER_ENDPOINT.replace("tcp/", "tls/", 1)
    return router.listen or (default,)


def _reachable(endpoint: str) -> str:
    """Where somebody on this host reaches what listens on all addresses."""
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def _option(key: str) -> str:
    return f"--{key.replace('_', '-')}"
