"""WaitTimeout: a wait that ran out, which is also the reason it still waited for."""

from __future__ import annotations

from functools import cache
from typing import Any

from zstate.errors.lookup import LookupFailed


class WaitTimeout(LookupFailed, TimeoutError):
    """A wait that ran out. Always raised as a subclass of the reason it still waited for."""

    reason: type[LookupFailed] = LookupFailed
    waited_s: float = 0.0

    def __str__(self) -> str:
        return f"after waiting {self.waited_s:g} s, {super().__str__()}"

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored_timeout, (self.reason, self.facts())


@cache
def _timeout_class(reason: type[LookupFailed]) -> type[WaitTimeout]:
    facts = {"reason": reason, "__doc__": WaitTimeout.__doc__}
    return type(f"{reason.__name__}Timeout", (WaitTimeout, reason), facts)


def _restored_timeout(reason: type[LookupFailed], facts: dict[str, Any]) -> WaitTimeout:
    error = _timeout_class(reason).__new__(_timeout_class(reason))
    error.__dict__.update(facts)
    return error


def timed_out(reason: LookupFailed, waited_s: float) -> WaitTimeout:
    """The same facts as ``reason``, as an error that is also a TimeoutError."""
    return _restored_timeout(type(reason), {**reason.__dict__, "waited_s": waited_s})
