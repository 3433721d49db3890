"""What a user may choose about the ros2 wire: the domain, the namespace, how frames are named."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

from zstate._util.suggestions import did_you_mean
from zstate.errors import InvalidInput
from zstate.wire.keys import ANY, check_robot

LAST_DOMAIN = 232
"""The largest ROS_DOMAIN_ID; the ports of a DDS with a larger one would not exist."""

_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_FOREIGN = re.compile(r"[^A-Za-z0-9_]")


@dataclass(frozen=True)
class Ros2Options:
    """Where in the ROS graph the robots stand. InvalidInput for values that ROS would not take.

    ``domain`` is the ROS_DOMAIN_ID. ``namespace`` is kept without outer slashes: "" is the root,
    "*" puts every robot into a namespace of its own name. ``frame_prefix`` stands before a robot's
    own frames, as robot_state_publisher's parameter of that name; a "*" in it is the robot's name,
    and "*/" is what is taken where all robots have namespaces and share /tf.
    ``tf`` says whether /tf and /tf_static are "global", as tf2 has them, or in the "namespace".
    ``hash`` is "iron" for ROS 2 from Iron on, or "humble", where types have none: it decides what is
    written, readers hear both. ``node`` is the name under which a writer stands in the ROS graph; that of
    its program unless given.
    """

    domain: int = 0
    namespace: str = ""
    frame_prefix: str = ""
    tf: Literal["global", "namespace"] = "global"
    hash: Literal["iron", "humble"] = "iron"
    node: str = ""

    def __post_init__(self) -> None:
        if self.domain not in range(LAST_DOMAIN + 1):
            raise _not_allowed("domain", self.domain, f"whole numbers from 0 to {LAST_DOMAIN}")
        object.__setattr__(self, "namespace", self.namespace.strip("/"))
        if self.namespace not in ("", ANY):
            _check_namespace(self.namespace)
        _check_prefix(self.frame_prefix)
        if self.tf not in ("global", "namespace"):
            raise _not_allowed("tf", self.tf, "'global' and 'namespace'")
        if self.hash not in ("iron", "humble"):
            raise _not_allowed("hash", self.hash, "'iron' and 'humble'")
        if self.node:
            _check_token("node", self.node)

    @classmethod
    def parse(cls, text: str) -> Ros2Options:
        """The options written as ``domain=5,namespace=r1``; an empty text gives the defaults.

        Raises InvalidInput for an unknown key, listing those there are, and for a value that is not
        allowed, saying which are.
        """
        given: dict[str, str] = {}
        for part in text.split(",") if text.strip() else ():
            key, equals, value = (piece.strip() for piece in part.partition("="))
            if not equals or key in given:
                problem = "is given twice" if equals else "is not written as key=value"
                raise InvalidInput(f"the ros2 option {key!r} {problem}; {_known()}")
            given[_check_key(key)] = value
        return cls(**_typed(given))

    def robot_namespace(self, robot: str) -> str:
        """The namespace of ``robot``'s topics, without outer slashes; "" is the root.

        Raises InvalidInput when it must be the robot's name and that is no ROS name.
        """
        check_robot(robot)
        if self.namespace == ANY:
            _check_token("robot", robot, " with namespace=*, where it becomes a ROS namespace")
            return robot
        return self.namespace

    def robot_frame_prefix(self, robot: str) -> str:
        """What stands before the frames of ``robot`` on ROS's side; may be empty.

        Robots in namespaces of their own that share /tf are told apart there: unless given, by their names.
        """
        shares_tf = self.namespace == ANY and self.tf == "global"
        prefix = self.frame_prefix or (f"{ANY}/" if shares_tf else "")
        return prefix.replace(ANY, check_robot(robot))


def _check_key(key: str) -> str:
    names = _names()
    if key not in names:
        hint = did_you_mean(key, names) or ";"
        raise InvalidInput(f"the ros2 wire has no option {key!r}{hint} {_known()}")
    return key


def _typed(given: dict[str, str]) -> dict[str, Any]:
    domain = given.get("domain", "0")
    # what is no number stays a text, which the constructor refuses with the values it allows
    return {**given, "domain": int(domain) if domain.isascii() and domain.isdecimal() else domain}


def _names() -> Sequence[str]:
    return [field.name for field in fields(Ros2Options)]


def _known() -> str:
    return f"known: {', '.join(_names())}, for instance 'domain=5,namespace=r1'"


def _check_namespace(namespace: str) -> None:
    if ANY in namespace:
        raise InvalidInput(
            f"the namespace {namespace!r} has a '*' within; write '*' alone, "
            "which puts every robot into a namespace of its own name"
        )
    for token in namespace.split("/"):
        _check_token("namespace", token, f" in {namespace!r}" if token != namespace else "")


def _check_token(what: str, token: str, where: str = "") -> None:
    if not _TOKEN.fullmatch(token):
        raise InvalidInput(
            f"the {what} {token!r}{where} {_token_problem(token)}; ROS names are made of letters, "
            f"digits and '_' and begin with no digit, for instance {_legal(token)!r}"
        )


def _token_problem(token: str) -> str:
    foreign = dict.fromkeys(_FOREIGN.findall(token))
    if foreign:
        return f"contains {' and '.join(map(repr, foreign))}"
    return "begins with a digit" if token else "is empty"


def _legal(token: str) -> str:
    legal = _FOREIGN.sub("_", token) or "r1"
    return legal if _TOKEN.fullmatch(legal) else f"_{legal}"


def _check_prefix(prefix: str) -> None:
    wrong = next((c for c in prefix if c.isspace() or not c.isprintable()), "")
    wrong = wrong or ("//" if "//" in prefix else "")
    if wrong or prefix.startswith("/"):
        problem = f"contains {wrong!r}" if wrong else "begins with a slash"
        raise InvalidInput(
            f"the frame_prefix {prefix!r} {problem}; it is put before frame names as it is: "
            "write 'r1/', or '*/' for the name of each robot"
        )


def _not_allowed(name: str, value: object, allowed: str) -> InvalidInput:
    return InvalidInput(f"the ros2 option {name} is {value!r}; allowed are {allowed}")
