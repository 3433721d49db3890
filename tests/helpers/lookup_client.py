"""A client of lookup services, as any program with Zenoh and JSON may be."""

from __future__ import annotations

import json

import zenoh

import zstate.errors
from zstate.errors import Unreachable
from zstate.net.session import Session
from zstate.transform import Transform


def query_lookup(
    session: Session, robot: str, target: str, source: str, at: int | None = None, *, timeout_s: float = 1.0
) -> Transform:
    """The pose of ``source`` in ``target`` at the stamp ``at`` [ns], or the newest one.

    Raises the error of the service with its facts, and Unreachable without a reply within ``timeout_s``.
    """
    instant = "" if at is None else f";at={at}"
    selector = f"zstate/{robot}/lookup?target={target};source={source}{instant}"
    # Without consolidation the first reply arrives before the end of the query.
    for reply in session.zenoh.get(selector, timeout=timeout_s, consolidation=zenoh.ConsolidationMode.NONE):
        if reply.ok is not None:
            return Transform.from_dict(json.loads(reply.ok.payload.to_bytes()))
        if reply.err is not None and str(reply.err.encoding) == "application/json":
            facts = json.loads(reply.err.payload.to_bytes())
            kind = getattr(zstate.errors, facts.pop("error"))
            error = kind.__new__(kind)  # the constructor differs from error to error
            error.args = (facts.pop("message"),)
            lists = {name: tuple(value) for name, value in facts.items() if isinstance(value, list)}
            error.__dict__.update(facts | lists)
            raise error
    raise Unreachable(f"no reply at {selector!r} within {timeout_s:g} s", endpoints=())
