"""Who may do what behind a router: its access control, from the key space.

What nobody is allowed is denied. Zenoh allows a message when a rule's key expression includes that of
the message, so that a robot cannot write to others by a wildcard either. ``**`` goes past chunks
that begin with ``@``, which are named apart: late joiners ask under ``@adv``, presence stands under
``@writer``, static edges are announced under ``@edge``, and clocks are compared under ``@clock``.
Whoever reads may say so, under ``@reader``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from zstate.errors import InvalidInput
from zstate.net.json5 import json5_text
from zstate.wire.keys import CLOCK_KEY, check_robot

Rule = dict[str, object]

_SAYS = ("put", "delete", "reply", "declare_queryable", "liveliness_token")
_ASKS = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")
_APART = ("@adv", "@writer", "@clock", "@edge", "@reader")
_IDENTITY = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")

_HEAD = """\
Access control for a Zenoh router: what no rule allows is denied.

{roles}
A name is the common name of a certificate (mTLS: enable_mtls in transport/link/tls) or a user
(transport/auth/usrpwd). A router that asks for neither knows nobody, and denies everything.
It is read when the router starts."""


@dataclass(frozen=True, slots=True)
class Fleet:
    """Who is who behind a router, by name: the common name of a certificate, or a user.

    A robot writes its own keys and reads these; of others it reads who they are, their static edges,
    which it must not contradict, and the simulated time. A viewer reads everything and writes nothing; an
    operator, moreover, commands joints. A timekeeper, moreover, writes the simulated time.
    Somebody may be several of these. ``namespace`` is that of the sessions behind the router, if they
    have one. Raises InvalidInput for names that cannot be names of identities.
    """

    robots: tuple[str, ...] = ()
    viewers: tuple[str, ...] = ()
    operators: tuple[str, ...] = ()
    timekeepers: tuple[str, ...] = ()
    namespace: str = ""

    def __post_init__(self) -> None:
        for name in self.names:
            _check_identity(name)
        check_namespace(self.namespace)
        if not self.names:
            raise InvalidInput("nobody is named; access control without names would deny everything")

    @property
    def names(self) -> tuple[str, ...]:
        """Everybody, each once."""
        return tuple(dict.fromkeys((*self.robots, *self.viewers, *self.operators, *self.timekeepers)))


def _check_identity(name: str) -> None:
    if not _IDENTITY.fullmatch(name):
        raise InvalidInput(
            f"{name!r} cannot be the name of an identity; use up to 64 of A-Z a-z 0-9 . _ -, beginning "
            "with a letter or digit"
        )


def check_namespace(namespace: str) -> str:
    """``namespace`` if it is empty or can stand before keys. Raises InvalidInput."""
    try:
        for chunk in namespace.split("/") if namespace else ():
            check_robot(chunk)
    except InvalidInput:
        raise InvalidInput(
            f"the namespace {namespace!r} is not made of chunks of a Zenoh key; write for instance 'site_1'"
        ) from None
    return namespace


def access_text(fleet: Fleet) -> str:
    """The access control of ``fleet`` as JSON5, which a router takes as its configuration or a part of it."""
    roles = {
        "robots": fleet.robots,
        "viewers": fleet.viewers,
        "operators": fleet.operators,
        "timekeepers": fleet.timekeepers,
    }
    lines = [f"{role + ':':<13}{', '.join(names)}\n" for role, names in roles.items() if names]
    return json5_text({"access_control": access_control(fleet)}, head=_HEAD.format(roles="".join(lines)))


def access_control(fleet: Fleet) -> dict[str, object]:
    """The section ``access_control`` of a Zenoh configuration."""
    roles = {name: list(_roles(name, fleet)) for name in fleet.names}
    used = {rule for rules in roles.values() for rule in rules}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for rule in _rules(fleet) if rule["id"] in used],
        "subjects": [subject for name in fleet.names for subject in _subjects(name)],
        "policies": [
            {"id": name, "rules": rules, "subjects": [str(one["id"]) for one in _subjects(name)]}
            for name, rules in roles.items()
        ],
    }


def _subjects(name: str) -> tuple[Rule, Rule]:
    # Apart, as one subject with both would be somebody who has both.
    return (
        {"id": f"certificate {name}", "cert_common_names": [name]},
        {"id": f"user {name}", "usernames": [name]},
    )


def _roles(name: str, fleet: Fleet) -> Iterator[str]:
    if name in fleet.robots:
        yield from (f"{name} writes", f"{name} reads", f"{name} is given")
        yield from ("robots read", "robots are given", "robots are asked")
    yield "readers are known"
    if name in (*fleet.viewers, *fleet.operators, *fleet.timekeepers):
        yield from ("viewers read", "viewers are given")
    if name in fleet.operators:
        yield "operators command"
    if name in fleet.timekeepers:
        yield "timekeepers write"


def _rules(fleet: Fleet) -> Iterator[Rule]:
    """Ingress is what somebody sends to the router, egress what the router passes on to them."""
    root = f"{fleet.namespace}/zstate" if fleet.namespace else "zstate"
    everything, clock = _under(root), root.removesuffix("zstate") + CLOCK_KEY
    statics = f"{root}/*/tf_static/*"
    shared = (statics, f"{statics}/@adv/**", f"{root}/*/@edge/**", f"{root}/*/@writer/**", clock)
    for robot in dict.fromkeys(fleet.robots):
        own = _under(f"{root}/{check_robot(robot)}")
        yield _rule(f"{robot} writes", "ingress", _SAYS, own)
        yield _rule(f"{robot} reads", "ingress", _ASKS, own)
        yield _rule(f"{robot} is given", "egress", _SAYS, own)
    yield _rule("robots read", "ingress", _ASKS, shared)
    yield _rule("robots are given", "egress", _SAYS, shared)
    # What is asked of all robots at once is asked of each; only its own is in what it answers.
    yield _rule("robots are asked", "egress", _ASKS, everything)
    yield _rule("viewers read", "ingress", _ASKS, everything)
    yield _rule("viewers are given", "egress", _SAYS, everything)
    yield _rule("readers are known", "ingress", ("liveliness_token",), (f"{root}/@reader/**",))
    yield _rule("operators command", "ingress", ("put",), (f"{root}/*/joint_commands",))
    yield _rule("timekeepers write", "ingress", ("put",), (clock,))


def _under(key: str) -> tuple[str, ...]:
    return (f"{key}/**", *(f"{key}/**/{chunk}/**" for chunk in _APART))


def _rule(name: str, flow: str, messages: Sequence[str], keys: Sequence[str]) -> Rule:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(keys),
    }
