"""RosAccess: who may do what in a fleet that speaks ROS 2 as rmw_zenoh_cpp does.

Topics and services stand under ``<domain>/``, late joiners ask under ``@adv`` below them, and the ROS
graph is made of tokens under ``@ros2_lv/<domain>/``, which tell node and topic with ``%`` for ``/``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from zstate.errors import InvalidInput
from zstate.net.access_rule import ASKS, SAYS, Rule, egress, ingress
from zstate.wire.ros2.options import Ros2Options

if TYPE_CHECKING:
    from zstate.net.access import Fleet

_OF_EVERY_NODE = ("rosout", "parameter_events")
"""Topics outside of all namespaces that each ROS node writes."""


class RosAccess:
    """The rules for ``fleet`` in one domain. Robots are told apart by their namespaces.

    A robot writes the topics of its namespace and answers its services, and stands in the graph with
    nothing else; /tf and /tf_static, where they are global, belong to all robots. A viewer hears all
    topics and calls no service, which an operator does. Raises InvalidInput for robots in one namespace.
    """

    def __init__(self, fleet: Fleet, options: Ros2Options) -> None:
        self._fleet = fleet
        self._options = options
        self._domain = str(options.domain)
        self._graph = f"@ros2_lv/{options.domain}"
        self._global = (*(("tf", "tf_static") if options.tf == "global" else ()), *_OF_EVERY_NODE)
        _check_apart(fleet.robots, [options.namespace_of(robot) for robot in fleet.robots])

    def roles(self, name: str) -> Iterator[str]:
        """The rules that ``name`` has, by their names."""
        fleet = self._fleet
        if name in fleet.robots:
            yield from map(self._id, (f"{name} writes", f"{name} reads", f"{name} is given"))
            yield from map(self._id, ("robots write", "robots read", "robots are given", "robots are asked"))
        if name in (*fleet.viewers, *fleet.operators, *fleet.timekeepers):
            yield from map(
                self._id, ("viewers are known", "viewers hear", "viewers ask", "viewers are given")
            )
        if name in fleet.operators:
            yield self._id("operators call")
        if name in fleet.timekeepers:
            yield self._id("timekeepers write")

    def rules(self) -> Iterator[Rule]:
        """All of them."""
        whole = (f"{self._domain}/**", f"{self._domain}/**/@adv/**", f"{self._graph}/**")
        clock = self._topic("clock")
        shared = tuple(key for name in self._global for key in self._topic(name))
        for robot in dict.fromkeys(self._fleet.robots):
            own = self._own(robot)
            yield ingress(self._id(f"{robot} writes"), SAYS, (*own, *self._tokens(robot)))
            yield ingress(self._id(f"{robot} reads"), ASKS, own)
            yield egress(self._id(f"{robot} is given"), SAYS, own)
        yield ingress(self._id("robots write"), SAYS, shared)
        yield ingress(self._id("robots read"), ASKS, (*shared, *clock, whole[2]))
        yield egress(self._id("robots are given"), SAYS, (*shared, *clock, whole[2]))
        # What is asked of all at once is asked of each; only its own is in what it answers.
        yield egress(self._id("robots are asked"), ASKS, whole)
        yield ingress(self._id("viewers are known"), ("liveliness_token",), self._reader_tokens())
        yield ingress(self._id("viewers hear"), ("declare_subscriber",), whole[:1])
        yield ingress(self._id("viewers ask"), ASKS, whole[1:])
        yield egress(self._id("viewers are given"), SAYS, whole)
        yield ingress(self._id("operators call"), ("query",), whole[:1])
        yield ingress(self._id("timekeepers write"), SAYS, (*clock, self._token("MP", "*", "%clock")))

    def _id(self, text: str) -> str:
        return f"{text} in ROS domain {self._domain}"

    def _own(self, robot: str) -> tuple[str, ...]:
        namespace = self._options.namespace_of(robot)
        return self._topic(namespace) if namespace else (f"{self._domain}/**", f"{self._domain}/**/@adv/**")

    def _topic(self, name: str) -> tuple[str, str]:
        return f"{self._domain}/{name}/**", f"{self._domain}/{name}/**/@adv/**"

    def _tokens(self, robot: str) -> Iterator[str]:
        """Its nodes, what they read, and what they offer of its own and of everybody's."""
        namespace = self._options.namespace_of(robot)
        if not namespace:
            yield f"{self._graph}/**"
            return
        root = "%" + namespace.replace("/", "%")
        for place in (root, f"{root}%$*"):
            for kind in ("NN", "MS", "SC"):
                yield f"{self._graph}/*/*/*/{kind}/*/{place}/**"
            yield self._token("SS", place, f"{root}%$*")
            for topic in (f"{root}%$*", *(f"%{name}" for name in self._global)):
                yield self._token("MP", place, topic)

    def _token(self, kind: str, place: str, topic: str) -> str:
        return f"{self._graph}/*/*/*/{kind}/*/{place}/*/{topic}/**"

    def _reader_tokens(self) -> tuple[str, ...]:
        nodes = (f"{self._graph}/*/*/*/{kind}/**" for kind in ("NN", "MS", "SC"))
        return (*nodes, f"{self._domain}/**/@adv/sub/**")


def _check_apart(robots: Sequence[str], namespaces: Sequence[str]) -> None:
    if len(set(robots)) > 1 and len(set(namespaces)) < len(set(robots)):
        raise InvalidInput(
            f"the robots {', '.join(map(repr, robots))} would write the same topics, so that access control "
            "could not tell them apart; give each a namespace of its name: 'ros2:namespace=*'"
        )
