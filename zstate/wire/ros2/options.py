"""Options of the ROS 2 wire formats: domain, namespace, frame names."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from typing import Any, Literal

from zstate._util.format import did_you_mean
from zstate.errors import InvalidInput
from zstate.wire.keys import ANY, check_robot

LAST_DOMAIN = 232
"""The largest ROS_DOMAIN_ID; the ports of a DDS with a larger one would not exist."""

_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_FOREIGN = re.compile(r"[^A-Za-z0-9_]")


@dataclass(frozen=True)
class Ros2Options:
    """The place of robots in the ROS graph. Raises InvalidInput for values that ROS does not allow.

    ``domain`` is the ROS_DOMAIN_ID. ``namespace`` is kept without outer slashes: "" is the root,
    "*" puts each robot into a namespace of its own name. ``frame_prefix`` is put before a robot's
    own frames, like robot_state_publisher's parameter of that name; a "*" in it is the robot's name.
    The default is "*/" if robots with namespaces share /tf.
    ``tf`` is "global" for /tf and /tf_static, as in tf2, or "namespace" for topics in the namespace.
    ``hash`` is "iron" for ROS 2 since Iron, or "humble", whose types have no hash; it applies to writers,
    readers accept both. ``node`` is a writer's name in the ROS graph; default: its program.
    """

    domain: int = 0
    namespace: str = ""
    frame_prefix: str = ""
    tf: Literal["global", "namespace"] = "global"
    hash: Literal["iron", "humble"] = "iron"
    node: str = ""

    def __post_init__(self) -> None:
        if self.domain not in range(LAST_DOMAIN + 1):
            raise _value_error("domain", self.domain, f"whole numbers from 0 to {LAST_DOMAIN}")
        object.__setattr__(self, "namespace", self.namespace.strip("/"))
        if self.namespace not in ("", ANY):
            if ANY in self.namespace:
                raise InvalidInput(
                    f"the namespace {self.namespace!r} has a '*' within; write '*' alone, "
                    "which puts every robot into a namespace of its own name"
                )
            for token in self.namespace.split("/"):
                check_token("namespace", token, f" in {self.namespace!r}" if token != self.namespace else "")
        _check_prefix(self.frame_prefix)
        if self.tf not in ("global", "namespace"):
            raise _value_error("tf", self.tf, "'global' and 'namespace'")
        if self.hash not in ("iron", "humble"):
            raise _value_error("hash", self.hash, "'iron' and 'humble'")
        if self.node:
            check_token("node", self.node)

    @classmethod
    def parse(cls, text: str) -> Ros2Options:
        """The options written as ``domain=5,namespace=r1``; an empty text gives the defaults.

        Raises InvalidInput for an unknown key, with the known ones, and for a value that is not allowed,
        with the allowed ones.
        """
        names = [field.name for field in fields(Ros2Options)]
        known = f"known: {', '.join(names)}, for instance 'domain=5,namespace=r1'"
        values: dict[str, Any] = {}
        for part in text.split(",") if text.strip() else ():
            key, equals, value = (piece.strip() for piece in part.partition("="))
            if not equals or key in values:
                problem = "is given twice" if equals else "is not written as key=value"
                raise InvalidInput(f"the ros2 option {key!r} {problem}; {known}")
            if key not in names:
                hint = did_you_mean(key, names) or ";"
                raise InvalidInput(f"the ros2 wire has no option {key!r}{hint} {known}")
            # other text stays: the constructor refuses it with the values it allows
            is_number = key == "domain" and value.isascii() and value.isdecimal()
            values[key] = int(value) if is_number else value
        return cls(**values)

    def robot_namespace(self, robot: str) -> str:
        """The namespace of ``robot``'s topics, without outer slashes; "" is the root.

        Raises InvalidInput if it must be the robot's name and this is no ROS name.
        """
        check_robot(robot)
        if self.namespace == ANY:
            check_token("robot", robot, " with namespace=*, where it becomes a ROS namespace")
            return robot
        return self.namespace

    def robot_frame_prefix(self, robot: str) -> str:
        """The prefix of ``robot``'s frames in ROS; may be empty.

        Robots in namespaces of their own that share /tf have their names as prefixes by default.
        """
        shares_tf = self.namespace == ANY and self.tf == "global"
        prefix = self.frame_prefix or (f"{ANY}/" if shares_tf else "")
        return prefix.replace(ANY, check_robot(robot))


def check_token(what: str, token: str, where: str = "") -> None:
    """Raise InvalidInput if ``token`` is no part of a ROS name; ``what`` and ``where`` describe it."""
    if _TOKEN.fullmatch(token):
        return
    foreign = dict.fromkeys(_FOREIGN.findall(token))
    problem = f"contains {' and '.join(map(repr, foreign))}" if foreign else "begins with a digit"
    legal = _FOREIGN.sub("_", token) or "r1"
    raise InvalidInput(
        f"the {what} {token!r}{where} {problem if token else 'is empty'}; ROS names are made of letters, "
        f"digits and '_' and begin with no digit, for instance "
        f"{legal if _TOKEN.fullmatch(legal) else f'_{legal}'!r}"
    )


def _check_prefix(prefix: str) -> None:
    wrong = next((c for c in prefix if c.isspace() or not c.isprintable()), "")
    wrong = wrong or ("//" if "//" in prefix else "")
    if wrong or prefix.startswith("/"):
        problem = f"contains {wrong!r}" if wrong else "begins with a slash"
        raise InvalidInput(
            f"the frame_prefix {prefix!r} {problem}; it is put before frame names as it is: "
            "write 'r1/', or '*/' for the name of each robot"
        )


def _value_error(name: str, value: object, allowed: str) -> InvalidInput:
    return InvalidInput(f"the ros2 option {name} is {value!r}; allowed are {allowed}")
