"""A rule of Zenoh's access control: who has it may send, or is given, some messages on some keys."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

Rule = dict[str, object]

SAYS = ("put", "delete", "reply", "declare_queryable", "liveliness_token")
ASKS = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")


def ingress(name: str, messages: Sequence[str], keys: Iterable[str]) -> Rule:
    """What somebody sends to the router."""
    return _rule(name, "ingress", messages, keys)


def egress(name: str, messages: Sequence[str], keys: Iterable[str]) -> Rule:
    """What the router passes on to somebody."""
    return _rule(name, "egress", messages, keys)


def _rule(name: str, flow: str, messages: Sequence[str], keys: Iterable[str]) -> Rule:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(keys),
    }
