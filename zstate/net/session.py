"""Session: the connection to the network, opened by ``connect``."""

from __future__ import annotations

import itertools
import math
import os
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Protocol

import zenoh

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe, fork_safe_lock
from zstate.errors import Closed, ConfigError, InvalidInput, PortBusy
from zstate.net.at_exit import close_at_exit, end_sessions, forked_text, join_at_exit, leak, session_opening
from zstate.net.config import (
    CONFIG_VARIABLE,
    CONNECT,
    FILE,
    LISTEN,
    MODE,
    ConfigSource,
    Mode,
    check_credentials,
    check_loopback_only,
    check_mode,
    default_config,
    endpoint_list,
    listen_endpoints,
    scouts_by_multicast,
)
from zstate.net.open import open_with_retry

if TYPE_CHECKING:
    from zstate.net.connection_monitor import ConnectionMonitor
    from zstate.net.dead_links import LinkListener
    from zstate.net.rendezvous import Rendezvous
    from zstate.net.security.credentials import Credentials
    from zstate.net.security.probe import ProbeSession

CLOSE_TIMEOUT_S = 0.8
_UNDECLARE_TIMEOUT_S = 0.5


class Undeclarable(Protocol):
    """An entity declared on a Zenoh session."""

    def undeclare(self) -> Any: ...


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

    Without arguments: discover every process of this host that does the same, and no other. Nothing leaves
    the host. Otherwise ``mode``, "peer" by default, is one of

    - ``"peer"``: a direct link to each of ``endpoints``, retried for ever, and to each peer that connects to
      ``listen``. Peers do not forward: two peers that share only a router receive nothing from each other,
      so connect to routers as a client;
    - ``"loopback"``: the same, but an endpoint that leaves this host is refused;
    - ``"lan"``: a peer that listens on every interface, at any port unless ``listen`` is given, and
      discovers other peers of this mode by multicast (224.0.0.224:7446). **Every process that reaches this
      host can connect**, unless there are ``credentials``. Without multicast give the ``endpoints`` of one
      peer that listens at a known port; all peers that do discover each other through it;
    - ``"client"``: all data goes through the first of ``endpoints`` that answers within ``timeout_s`` [s];
      a lost link is retried at all of them for ever;
    - ``"router"``: clients and peers connect to ``listen`` (tcp/127.0.0.1:7447 by default).

    ``credentials`` are the identity of this session and the authorities it trusts. With certificates every
    endpoint is tls/... or quic/... .

    ``config`` is a Zenoh configuration (a JSON5 file, a mapping or a ``zenoh.Config``), used unchanged;
    without one, the file named by the environment variable ``ZENOH_CONFIG``. ``endpoints``, ``listen``,
    ``credentials`` and a ``mode`` other than "peer" replace their part of it.

    Without ``config``, ``mode``, ``endpoints`` and ``listen``, the environment is read, as by zstate's
    commands: ``ZSTATE_MODE``, ``ZSTATE_CONNECT`` and ``ZSTATE_LISTEN`` (endpoints separated by blanks; a
    client if only ZSTATE_CONNECT is set), ``ZSTATE_CONFIG``, and the credentials: ``ZSTATE_CERTS`` with
    ``ZSTATE_IDENTITY``, ``ZSTATE_USER`` with ``ZSTATE_PASSWORD`` or ``ZSTATE_PASSWORD_FILE``. So programs
    started by ``zstate up`` join its network.

    Raises InvalidInput or ConfigError for unusable arguments; a client also raises Unreachable if no router
    answers and AccessDenied if all that answer deny it; PortBusy, NetworkError. The other modes retry; a
    denial and its reason are logged as a warning.
    """
    is_in_environment = any(os.environ.get(name) for name in (MODE, CONNECT, LISTEN, FILE))
    if is_in_environment and config is None and mode is None and not endpoints and not listen:
        from zstate.net.environment import blame_variable, settings_from_environment  # noqa: PLC0415 - as below

        settings = settings_from_environment()
        if settings is not None:
            with blame_variable():
                return connect(
                    settings.config,
                    mode=settings.mode,
                    endpoints=settings.endpoints,
                    listen=settings.listen,
                    timeout_s=timeout_s,
                    credentials=credentials or settings.credentials,
                )
    if not (math.isfinite(timeout_s) and timeout_s > 0.0):
        raise InvalidInput(f"timeout_s is {timeout_s}; give a positive number of seconds")
    checked, endpoints, listen = check_mode(mode or "peer"), endpoint_list(endpoints), endpoint_list(listen)
    if checked == "loopback":
        check_loopback_only((*endpoints, *listen))
    if credentials is not None:
        credentials.check_endpoints(endpoints, listen)
        credentials.check_files()
    source = config if config is not None else os.environ.get(CONFIG_VARIABLE) or None
    with session_opening():
        if source is None:
            return _connect(checked, endpoints, listen, timeout_s, credentials)
        if checked == "loopback":
            raise ConfigError(
                "mode 'loopback' stays on this host, and a Zenoh configuration could leave it; drop the "
                f"configuration ({CONFIG_VARIABLE} names one, too), or the mode",
                path="mode",
            )
        from zstate.net import user_config as given  # noqa: PLC0415 - most sessions have the default settings

        user = given.user_config(source, checked, endpoints, listen, credentials)
        endpoints = endpoints or given.endpoints_in(user)
        credentials = credentials or given.credentials_in(user)
        return _session(user, endpoints, credentials, given.connect_timeout(user))


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
    listen = listen_endpoints(mode, listen, credentials)
    check_credentials(mode, credentials, listen)
    # With time to wait, Zenoh spends all of it on the first endpoint; without, it tries each once.
    config = default_config(mode, endpoints, listen, 0.0 if mode == "client" else None, credentials)
    return _session(config, endpoints, credentials, timeout_s if mode == "client" else 0.0)


def _session(
    config: zenoh.Config, endpoints: Sequence[str], credentials: Credentials | None, timeout_s: float
) -> Session:
    raw = open_with_retry(config, endpoints, credentials, timeout_s)
    monitor = _connection_monitor(raw, config, endpoints, credentials)
    probe = None
    if credentials is not None:
        from zstate.net.security.probe import ProbeSession  # noqa: PLC0415 - as above

        probe = ProbeSession.for_config(config, credentials)
    limited = None
    if "tls/" in config.get_json("connect/endpoints") + config.get_json("listen/endpoints"):
        from zstate.net.dead_links import limit_dead_links  # noqa: PLC0415 - as above

        limited = limit_dead_links(raw, config)
    return Session(raw, monitor, probe=probe, limited=limited)


def _connection_monitor(
    raw: zenoh.Session, config: zenoh.Config, endpoints: Sequence[str], credentials: Credentials | None
) -> ConnectionMonitor | None:
    """The monitor of a session that others can deny; None if it only listens."""
    if not endpoints and not scouts_by_multicast(config):
        return None
    from zstate.net.connection_monitor import ConnectionMonitor  # noqa: PLC0415  # not of most sessions

    return ConnectionMonitor(raw, config, endpoints, credentials)


def _connect_on_this_host(mode: Mode, credentials: Credentials | None) -> Session:
    if credentials is not None:
        raise ConfigError(
            "processes of one host connect without credentials; give the network they are for: endpoints= "
            "(--connect) or listen= (--listen)",
            path="credentials",
        )
    # Sessions with endpoints do not meet there.
    from zstate.net.rendezvous import Rendezvous, free_endpoint, rendezvous_addresses  # noqa: PLC0415

    addresses = rendezvous_addresses()
    if mode == "loopback":
        check_loopback_only([f"tcp/{host}:{port}" for host, port in addresses])
    # The rendezvous peer first: without one, opening a session takes half a second longer.
    rendezvous = Rendezvous(addresses)
    try:
        while True:
            endpoint = free_endpoint()
            with suppress(PortBusy):  # another process took it first
                raw = open_with_retry(default_config("peer", [rendezvous.endpoint], [endpoint]), ())
                break
        rendezvous.watch(raw, endpoint)
    except BaseException:
        rendezvous.close()
        raise
    return Session(raw, rendezvous)


class Session(Closeable):
    """Connection to the network, opened by ``connect``; a context manager.

    Thread-safe, but not usable in a process forked from the one that connected.
    """

    def __init__(
        self,
        raw: zenoh.Session,
        companion: Rendezvous | ConnectionMonitor | None = None,
        *,
        probe: ProbeSession | None = None,
        limited: LinkListener | None = None,
    ) -> None:
        self._raw = raw
        self._limited_links = limited
        self._companion = companion
        self._pid = os.getpid()
        self._closed = False
        self.is_usable = True
        """False once this session is closed, and in a forked process."""
        self._lock = fork_safe_lock()
        self._numbers = itertools.count()
        self._nodes: BoundedDict[tuple[str, str], tuple[int, bool]] = BoundedDict()
        """The number of a node by robot and program, and whether it has a writer."""
        self._ended_queryables: set[str] = set()
        self.zid = str(raw.zid())
        self.opened_at = time.monotonic()
        self.probe = probe
        close_at_exit(self)
        fork_safe(self)

    def __del__(self) -> None:
        self.close_blocking()

    def __repr__(self) -> str:
        return f"Session({self.zid}{', closed' if self._closed else ''})"

    @property
    def zenoh(self) -> zenoh.Session:
        """The Zenoh session, for features that zstate lacks. Raises Closed."""
        self.check()
        return self._raw

    def next_number(self) -> int:
        """The next of the numbers 0, 1, 2, ..., unique in this session."""
        return next(self._numbers)

    def node_number(self, robot: str, program: str, *, is_writer: bool = False) -> int:
        """The number of a node in a ROS graph: all readers of ``robot`` in ``program``, and its first writer.

        Further writers are nodes of their own: what one node writes shows what it computes.
        """
        node = (robot, program)
        with self._lock:
            number, has_writer = self._nodes.get(node) or (self.next_number(), False)
            if is_writer and has_writer:
                return self.next_number()
            self._nodes[node] = number, has_writer or is_writer
            return number

    # zenoh 1.10, a queryable stays in the routes while another session has an equal one: delete when fixed
    # (eclipse-zenoh/zenoh pull request 2660 mends that between routers, not for clients and peers)
    def on_queryable_end(self, key: str) -> None:
        """Note that this session has undeclared a queryable on ``key``, which other sessions may have, too.

        Once this session had closed, queries on ``key`` would end only at their timeout.
        """
        if "/@" not in key:  # keys of one writer each, without end
            self._ended_queryables.add(key)

    def check(self) -> None:
        """Raise Closed if this session is closed, or belongs to the process that this one was forked from."""
        if self.is_usable:
            return
        if self._closed:
            raise Closed("this session is closed; connect() again")
        raise Closed(forked_text(f"this session belongs to process {self._pid}"))

    def _at_fork_reinit(self) -> None:
        self.is_usable = False

    def release(self, entity: Undeclarable) -> None:
        """Undeclare an entity of this session. Does nothing if the entity or the session is closed.

        Waits until no other thread is using the entity, or gives up after 0.5 s.
        """
        if os.getpid() != self._pid:
            leak(entity)
            return
        deadline = time.monotonic() + _UNDECLARE_TIMEOUT_S
        while not self._closed:
            try:
                entity.undeclare()
            except zenoh.ZError:
                return
            except RuntimeError as error:
                # zenoh 1.10, an entity that another thread uses cannot be undeclared: delete when fixed
                if "borrowed" not in str(error):
                    raise
            else:
                return
            if time.monotonic() >= deadline:
                return
            time.sleep(0.001)

    def close(self) -> None:
        """Leave the network within a second. A second call does nothing."""
        if not self._mark_closed():
            return
        # A link to a frozen process can delay Zenoh's own close; the caller does not wait for that.
        thread = join_at_exit(threading.Thread(target=self._close, name="zstate close", daemon=True))
        try:
            thread.start()
        except RuntimeError:
            if threading.main_thread().is_alive():
                raise
            end_sessions(self._close)  # Python is ending, and starts no more threads
        else:
            thread.join(CLOSE_TIMEOUT_S)

    def close_blocking(self) -> None:
        """``close`` in this thread, where a link to a frozen process can delay it for ten seconds."""
        if self._mark_closed():
            self._close()

    def leak(self) -> None:
        """Never free Zenoh's session, not even when the interpreter ends: that hangs in a forked process."""
        leak(self._raw)

    def _mark_closed(self) -> bool:
        """Returns whether the session was open, and belongs to this process."""
        with self._lock:
            if self._closed or os.getpid() != self._pid:
                return False
            self._closed = True
            self.is_usable = False
        return True

    def _close(self) -> None:
        if self._companion is not None:
            self._companion.close()
        with suppress(zenoh.ZError):  # it was delayed for too long
            # A queryable that its session still has at its end is removed from all routes.
            channel: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(1)
            held = [self._raw.declare_queryable(key, channel) for key in tuple(self._ended_queryables)]
            self._raw.close()
            del held
