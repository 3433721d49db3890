"""NativeAccess: who may do what in a fleet that speaks zstate's own wire.

``**`` goes past chunks that begin with ``@``, which are named apart: late joiners ask under ``@adv``,
presence stands under ``@writer``, static edges are announced under ``@edge``, and clocks are compared
under ``@clock``. Whoever reads may say so, under ``@reader``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from zstate.net.access_rule import ASKS, SAYS, Rule, egress, ingress
from zstate.wire.keys import CLOCK_KEY, check_robot

if TYPE_CHECKING:
    from zstate.net.access import Fleet

_APART = ("@adv", "@writer", "@clock", "@edge", "@reader")


class NativeAccess:
    """The rules for ``fleet``."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet

    def roles(self, name: str) -> Iterator[str]:
        """The rules that ``name`` has, by their names."""
        fleet = self._fleet
        if name in fleet.robots:
            yield from (f"{name} writes", f"{name} reads", f"{name} is given")
            yield from ("robots read", "robots are given", "robots are asked")
        elif name in fleet.placers:
            yield from (f"{name} places", "robots read", "robots are given", "robots are asked")
        yield "readers are known"
        if name in (*fleet.viewers, *fleet.operators, *fleet.timekeepers):
            yield from ("viewers read", "viewers are given")
        if name in fleet.operators:
            yield "operators command"
        if name in fleet.timekeepers:
            yield "timekeepers write"

    def rules(self) -> Iterator[Rule]:
        """All of them."""
        fleet = self._fleet
        root = f"{fleet.namespace}/zstate" if fleet.namespace else "zstate"
        everything, clock = _under(root), root.removesuffix("zstate") + CLOCK_KEY
        statics = f"{root}/*/tf_static/*"
        shared = (statics, f"{statics}/@adv/**", f"{root}/*/@edge/**", f"{root}/*/@writer/**", clock)
        for robot in dict.fromkeys(fleet.robots):
            own = _under(f"{root}/{check_robot(robot)}")
            yield ingress(f"{robot} writes", SAYS, own)
            yield ingress(f"{robot} reads", ASKS, own)
            yield egress(f"{robot} is given", SAYS, own)
        for placer in dict.fromkeys(fleet.placers):
            own = f"{root}/{check_robot(placer)}"
            edges = (f"{own}/tf_static/*", f"{own}/tf_static/*/@adv/**")
            yield ingress(f"{placer} places", SAYS, (*edges, f"{own}/@writer/tf_static/*", f"{own}/@edge/**"))
        yield ingress("robots read", ASKS, shared)
        yield egress("robots are given", SAYS, shared)
        # What is asked of all robots at once is asked of each; only its own is in what it answers.
        yield egress("robots are asked", ASKS, everything)
        yield ingress("viewers read", ASKS, everything)
        yield egress("viewers are given", SAYS, everything)
        yield ingress("readers are known", ("liveliness_token",), (f"{root}/@reader/**",))
        yield ingress("operators command", ("put",), (f"{root}/*/joint_commands",))
        yield ingress("timekeepers write", ("put",), (clock,))


def _under(key: str) -> tuple[str, ...]:
    return (f"{key}/**", *(f"{key}/**/{chunk}/**" for chunk in _APART))
