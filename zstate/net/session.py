"""The connection to the network.

Undeclaring: taking back what was declared on a Zenoh session, whoever uses it just then.
"""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import itertools
import math
import os
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Protocol

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.errors import Closed, ConfigError, InvalidInput, PortBusy
from zstate.net.at_exit import close_at_exit, end_sessions, forked_text, join_at_exit, leak, session_opening
from zstate.net.config import (
    CONFIG_VARIABLE,
    ConfigSource,
    Mode,
    blame_variable,
    check_credentials,
    check_loopback_only,
    check_mode,
    credentials_in,
    default_config,
    endpoint_list,
    endpoints_in,
    listen_endpoints,
    said_in_environment,
    user_config,
)
from zstate.net.open import connect_timeout, open_with_retry
from zstate.net.rendezvous import Rendezvous, free_endpoint, rendezvous_addresses
from zstate.net.security.connection_monitor import ConnectionMonitor, ProbeSession
from zstate.net.security.credentials import Credentials

_WITHIN_S = 0.5


class Undeclarable(Protocol):
    """Whatever was declared on a Zenoh session."""

    def undeclare(self) -> Any: ...


def undeclare(entity: Undeclarable) -> None:
    """Take ``entity`` back, as soon as no other thread is using it."""
    deadline = time.monotonic() + _WITHIN_S
    while not _try_undeclare(entity) and time.monotonic() < deadline:
        time.sleep(0.001)


def _try_undeclare(entity: Undeclarable) -> bool:
    try:
        entity.undeclare()
    except RuntimeError as error:
        if "borrowed" not in str(error):
            raise
        return False  # another thread is using it at this very moment
    return True


CLOSE_WITHIN_S = 0.8


def connect(
    config: ConfigSource | None = None,
    *,
    mode: str | None = None,
    endpoints: str | Sequence[str] = (),
    listen: str | Sequence[str] = (),
    timeout_s: float = 5.0,
    credentials: Credentials | None = None,
) -> Session:
    """Join the network.

    Without arguments: meet every process of this host that does the same, and nobody else. Nothing
    leaves the host. Otherwise ``mode``, "peer" unless given, is one of

    - ``"peer"``: a direct link to each of ``endpoints``, kept up for ever whether or not somebody
      answers yet, and to whoever comes to ``listen``. Peers do not pass on what others say: two of them
      that share nothing but a router hear nothing of each other, so towards routers be a client;
    - ``"loopback"``: the same, and an endpoint that leaves this host is refused;
    - ``"lan"``: a peer that listens on every interface, at any port unless ``listen`` says where, and
      finds the others of this mode by multicast (224.0.0.224:7446). **It is open to whoever reaches this
      host**, unless there are ``credentials``. Where multicast is blocked it is alone: give the ``endpoints``
      of one that listens at a known port, and all who do meet each other through it;
    - ``"client"``: everything goes through the first of ``endpoints`` that answers, within
      ``timeout_s`` [s]; once lost, all of them are sought for ever;
    - ``"router"``: clients and peers connect to ``listen`` (tcp/127.0.0.1:7447 unless given).

    ``credentials`` say who this session is and whom it trusts. With certificates every endpoint is
    tls/... or quic/... .

    ``config`` is a Zenoh configuration (a JSON5 file, a mapping or a ``zenoh.Config``), taken as it is;
    without one, the file named by the environment variable ``ZENOH_CONFIG``. ``endpoints``, ``listen``,
    ``credentials`` and a ``mode`` other than "peer" then replace what it says.

    Where ``config``, ``mode``, ``endpoints`` and ``listen`` say nothing, the environment is asked, as by
    zstate's commands: ``ZSTATE_MODE``, ``ZSTATE_CONNECT`` and ``ZSTATE_LISTEN`` (endpoints with blanks
    between them; a client, if only they say where to connect), ``ZSTATE_CONFIG``, and who this is:
    ``ZSTATE_CERTS`` with ``ZSTATE_IDENTITY``, ``ZSTATE_USER`` with ``ZSTATE_PASSWORD`` or
    ``ZSTATE_PASSWORD_FILE``. So the programs that `zstate up` starts are on its network.

    Raises InvalidInput or ConfigError for what cannot be used, Unreachable where nobody answers,
    AccessDenied where all who do refuse, PortBusy, NetworkError. The other modes go on trying; who refuses
    them, and why, is logged as a warning.
    """
    if config is None and mode is None and not endpoints and not listen:
        said = said_in_environment()
        if said is not None:
            with blame_variable():
                return connect(
                    said.config,
                    mode=said.mode,
                    endpoints=said.endpoints,
                    listen=said.listen,
                    timeout_s=timeout_s,
                    credentials=credentials or said.credentials,
                )
    checked = _check(mode or "peer", endpoints, listen, timeout_s)
    if credentials is not None:
        _check_credentials(credentials, checked[1], checked[2])
    source = config if config is not None else os.environ.get(CONFIG_VARIABLE) or None
    with session_opening():
        if source is None:
            return _connect(*checked, timeout_s, credentials)
        return _connect_as_configured(source, *checked, credentials)


def _connect_as_configured(
    source: ConfigSource,
    mode: Mode,
    endpoints: tuple[str, ...],
    listen: tuple[str, ...],
    credentials: Credentials | None,
) -> Session:
    if mode == "loopback":
        raise ConfigError(
            "mode 'loopback' stays on this host, and a Zenoh configuration could leave it; drop the "
            f"configuration ({CONFIG_VARIABLE} names one, too), or the mode",
            path="mode",
        )
    given = user_config(source, mode, endpoints, listen, credentials)
    where = endpoints or endpoints_in(given)
    return _session(given, where, credentials or credentials_in(given), connect_timeout(given))


def _check(
    mode: str, endpoints: str | Sequence[str], listen: str | Sequence[str], timeout_s: float
) -> tuple[Mode, tuple[str, ...], tuple[str, ...]]:
    if not (math.isfinite(timeout_s) and timeout_s > 0.0):
        raise InvalidInput(f"timeout_s is {timeout_s}; give a positive number of seconds")
    checked = check_mode(mode), endpoint_list(endpoints), endpoint_list(listen)
    if checked[0] == "loopback":
        check_loopback_only((*checked[1], *checked[2]))
    return checked


def _check_credentials(credentials: Credentials, endpoints: Sequence[str], listen: Sequence[str]) -> None:
    from zstate.net.security.credential_files import check_files  # noqa: PLC0415  # loads ssl, which few need

    credentials.check_endpoints(endpoints, listen)
    check_files(credentials)


def _connect(
    mode: Mode,
    endpoints: Sequence[str],
    listen: Sequence[str],
    timeout_s: float,
    credentials: Credentials | None,
) -> Session:
    if mode == "client" and not endpoints:
        raise InvalidInput("mode 'client' needs endpoints=, for instance 'tcp/192.168.1.10:7447'")
    if mode in ("peer", "loopback") and not (endpoints or listen):
        return _connect_on_this_host(mode, credentials)
    where = listen_endpoints(mode, listen, credentials)
    check_credentials(mode, credentials, where)
    # With time to wait, Zenoh spends all of it on the first endpoint; without, it asks each once.
    config = default_config(mode, endpoints, where, 0.0 if mode == "client" else None, credentials)
    return _session(config, endpoints, credentials, timeout_s if mode == "client" else 0.0)


def _session(
    config: zenoh.Config, endpoints: Sequence[str], credentials: Credentials | None, timeout_s: float
) -> Session:
    raw = open_with_retry(config, endpoints, credentials, timeout_s)
    watch = ConnectionMonitor(raw, config, endpoints, credentials)
    return Session(raw, watch, twin=ProbeSession.for_config(config, credentials))


def _connect_on_this_host(mode: Mode, credentials: Credentials | None) -> Session:
    if credentials is not None:
        raise ConfigError(
            "programs of one host meet without credentials; say whom these are for: endpoints= "
            "(--connect) or listen= (--listen)",
            path="credentials",
        )
    addresses = rendezvous_addresses()
    if mode == "loopback":
        check_loopback_only([f"tcp/{host}:{port}" for host, port in addresses])
    # The lobby first: while the rendezvous is silent, opening a session takes half a second longer.
    rendezvous = Rendezvous(addresses)
    try:
        raw, endpoint = _open_on_this_host(rendezvous.endpoint)
        rendezvous.watch(raw, endpoint)
    except BaseException:
        rendezvous.close()
        raise
    return Session(raw, rendezvous)


def _open_on_this_host(lobby: str) -> tuple[zenoh.Session, str]:
    while True:
        endpoint = free_endpoint()
        with suppress(PortBusy):  # somebody took it in between
            return open_with_retry(default_config("peer", [lobby], [endpoint]), ()), endpoint


class Session(Closeable):
    """A place on the network. Made by ``connect``; a context manager.

    Safe to use from any thread, but not in a process forked from the one that connected.
    """

    def __init__(
        self,
        raw: zenoh.Session,
        companion: Rendezvous | ConnectionMonitor | None = None,
        *,
        twin: ProbeSession | None = None,
    ) -> None:
        self._raw = raw
        self._companion = companion
        self._pid = os.getpid()
        self._closed = False
        self._lock = fork_safe_lock()
        self._numbers = itertools.count()
        self.zid = str(raw.zid())
        self.opened_at = time.monotonic()
        self.probe = twin
        close_at_exit(self)

    def __del__(self) -> None:
        self.leave()

    def __repr__(self) -> str:
        return f"Session({self.zid}{', closed' if self._closed else ''})"

    @property
    def zenoh(self) -> zenoh.Session:
        """The Zenoh session itself, for what zstate does not do. Raises Closed."""
        self.check()
        return self._raw

    def next_number(self) -> int:
        """A number that nothing else of this session has: 0, 1, 2, ..."""
        return next(self._numbers)

    def check(self) -> None:
        """Raise Closed if this session cannot be used any more, or not in this process."""
        if self._closed:
            raise Closed("this session is closed; connect() again")
        if os.getpid() != self._pid:
            raise Closed(forked_text(f"this session belongs to process {self._pid}"))

    def release(self, entity: Undeclarable) -> None:
        """Undeclare something of this session. Nothing happens if that, or the session, is gone."""
        if os.getpid() != self._pid:
            leak(entity)
        elif not self._closed:
            with suppress(zenoh.ZError):
                undeclare(entity)

    def close(self) -> None:
        """Leave the network within a second. A second call does nothing."""
        if self._is_last_call():
            _run_bounded(self._leave)

    def leave(self) -> None:
        """``close`` in this thread, where a link to a frozen process can hold it up for ten seconds."""
        if self._is_last_call():
            self._leave()

    def keep_for_ever(self) -> None:
        """Never free Zenoh's session, not even at the interpreter's end: in a forked process that hangs."""
        leak(self._raw)

    def _is_last_call(self) -> bool:
        with self._lock:
            if self._closed or os.getpid() != self._pid:
                return False
            self._closed = True
        return True

    def _leave(self) -> None:
        if self._companion is not None:
            self._companion.close()
        with suppress(zenoh.ZError):  # it was held up for too long
            self._raw.close()


def _run_bounded(action: Callable[[], None]) -> None:
    # A link to a frozen process can hold Zenoh's own close up; whoever closes does not wait for that.
    thread = join_at_exit(threading.Thread(target=action, name="zstate close", daemon=True))
    try:
        thread.start()
    except RuntimeError:
        if threading.main_thread().is_alive():
            raise
        end_sessions(action)  # Python is ending, and starts no more threads
    else:
        thread.join(CLOSE_WITHIN_S)
