"""The links of what ROS nodes say in one namespace, where topics are shared by whoever publishes them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from zstate.cli.doctor.check import Check, broken, ok, skipped, warning
from zstate.cli.doctor.clock_checks import stamps_check
from zstate.cli.doctor.ear import Ear
from zstate.cli.doctor.robot_checks import (
    limits_check,
    model_check,
    poses_check,
    refused_check,
    statics_check,
)
from zstate.cli.doctor.samples import StreamSamples, WriterSamples
from zstate.cli.output.console import count_text, rate_text
from zstate.cli.output.wire_text import RosMessages
from zstate.errors import format_duration
from zstate.model.robot import RobotModel
from zstate.net.session import Session

_FEW = 6


def ros_checks(ear: Ear, session: Session, words: RosMessages, called: str) -> Iterator[Check]:
    """Every link of what ``ear`` has heard for a while; ``called`` is the model that is meant, "*" any."""
    for check in _checks(ear, session, words, called):
        yield replace(check, text=words.translate(check.text), next=words.translate(check.next))


def _checks(ear: Ear, session: Session, words: RosMessages, called: str) -> Iterator[Check]:
    yield _writers_check(ear)
    if ear.is_mute and not any(nodes.writers for nodes in ear.nodes.values()):
        yield _mute_check(ear)
        return
    model, check = _model_check(ear, words, called)
    yield check
    yield _joints_check(ear, model, words)
    yield _transforms_check(ear, words)
    yield stamps_check(ear, session)
    if model is not None:
        ranges = [node.ranges for node in ear.nodes["joint_states"].writers.values()]
        yield from limits_check(ear, model, ranges, f"zstate echo{_named(ear, words)}")
    yield statics_check(ear)
    yield poses_check(ear, model)


def _writers_check(ear: Ear) -> Check:
    descriptions = ear.writers("robot_description")
    if len(descriptions) > 1:
        who = _listed(str(writer) for writer in descriptions)
        text = (
            f"{count_text(len(descriptions), 'node')} publish the model, {who}: readers take what came last"
        )
        return warning("writers", text, "zstate ls  # end one of them, or give each robot a namespace")
    streams: dict[str, list[str]] = {}
    for stream, writer in ear.info.writers:
        streams.setdefault(str(writer), []).append(stream)
    said = [f"{node} ({', '.join(dict.fromkeys(streams))})" for node, streams in streams.items()]
    return ok("writers", "; ".join(said))


def _mute_check(ear: Ear) -> Check:
    nodes = _listed(dict.fromkeys(str(writer) for _, writer in ear.info.writers))
    text = f"{nodes} announced, and nothing they say arrives: they are silent, or the router's access control"
    return broken("writers", f"{text} keeps it from whoever asks here", "zstate ls")


def _model_check(ear: Ear, words: RosMessages, called: str) -> tuple[RobotModel | None, Check]:
    topic = words.topic(ear.info.name, "robot_description")
    if not (ear.description or ear.writers("robot_description") or ear.nodes["tf"].writers):
        return None, broken("model", f"nobody publishes {topic}", _publish(ear, words))
    model, check = model_check(ear)
    if model is None or called in ("*", ear.info.name, model.name):
        return model, check
    text = f"{topic} carries {model.name!r}, and not {called!r}; {check.text}"
    return model, warning("model", text, "zstate ls  # which domain and namespace is it in?")


def _named(ear: Ear, words: RosMessages) -> str:
    """The robot as commands want to be told, which they are not where the wire can mean only one."""
    return "" if words.robot else f" {ear.info.name}"


def _publish(ear: Ear, words: RosMessages) -> str:
    return "zstate publish FILE" if words.robot else f"zstate publish FILE --name {ear.info.name}"


def _joints_check(ear: Ear, model: RobotModel | None, words: RosMessages) -> Check:
    topic = words.topic(ear.info.name, "joint_states")
    writers, heard = ear.writers("joint_states"), ear.nodes["joint_states"].writers
    if not heard and not writers:
        return _undriven_check(ear, model, topic)
    if not heard:
        nodes = _listed(str(writer) for writer in writers)
        text = f"{nodes} announced on {topic}, but no message comes"
        return broken("joint_states", text, f"zstate hz{_named(ear, words)} --stream joint_states")
    rates = _rates_text(ear, ear.nodes["joint_states"])
    silent = _silent_node(ear, heard)
    if silent:
        then = f"zstate hz{_named(ear, words)} --stream joint_states"
        return broken("joint_states", f"{silent}; of all: {rates}", then)
    if model is None:
        return ok("joint_states", rates)
    return _shared_check(ear, model, heard, rates, f"zstate echo{_named(ear, words)} --once")


def _undriven_check(ear: Ear, model: RobotModel | None, topic: str) -> Check:
    if ear.nodes["tf"].writers:
        return skipped("joint_states", f"nobody publishes {topic}; poses come ready made on tf")
    if model is not None and not model.joint_names:
        return ok("joint_states", "the model has no joint that moves")
    waiting = ear.writers("tf") or ear.writers("robot_description")
    waits = f", for which {waiting[-1]} waits" if waiting else ""
    text = f"nobody publishes {topic}{waits}: the robot's driver is not running (any more)"
    return broken("joint_states", text, "zstate joints FILE  # moves it, until the driver runs")


def _shared_check(
    ear: Ear, model: RobotModel, heard: Mapping[int, WriterSamples], rates: str, echo: str
) -> Check:
    """Whether each joint of ``model`` is told by one node; joints of others may be told as well."""
    own = set(model.joint_names)
    told = [(_node(ear, session), name) for session, node in heard.items() for name in node.names]
    missing = [name for name in model.joint_names if name not in {name for _, name in told}]
    if len(missing) == len(own):
        names = _listed((repr(name) for _, name in told), _FEW)
        text = f"none of the joints on it ({names}) is one of the model {model.name!r}: {rates}"
        return broken("joint_states", text, f"{echo}  # and compare it with `zstate check FILE`")
    for name in model.joint_names:
        tellers = [node for node, said in told if said == name]
        if len(tellers) > 1:
            text = f"the joint {name!r} is told by {_listed(tellers)}: what follows it jumps between them"
            return warning("joint_states", f"{text}; {rates}", "zstate ls  # end one of them")
    if missing:
        names = _listed(map(repr, missing), _FEW)
        text = f"nobody tells {count_text(len(missing), 'joint')} of the model: {names}; {rates}"
        return warning("joint_states", text, f"{echo}  # shows those that are told")
    strange = list(dict.fromkeys(name for _, name in told if name not in own))
    if strange:
        rates += f"; {count_text(len(strange), 'joint')} of no concern: {_listed(map(repr, strange), _FEW)}"
    return ok("joint_states", rates)


def _transforms_check(ear: Ear, words: RosMessages) -> Check:
    heard = ear.nodes["tf"].writers
    if not heard:
        return _no_transforms_check(ear, words)
    refused = refused_check(ear)
    if refused is not None:
        return refused
    rates, silent = _rates_text(ear, ear.nodes["tf"]), _silent_node(ear, heard)
    for child in dict.fromkeys(name for node in heard.values() for name in node.names):
        tellers = [_node(ear, session) for session, node in heard.items() if child in node.names]
        if len(tellers) > 1:
            text = f"{child!r} is placed by {_listed(tellers)}: it jumps between them; {rates}"
            return warning("tf", text, "zstate ls  # end one of them, or give each robot a namespace")
    if silent:
        return warning("tf", f"{silent}; of all: {rates}", f"zstate hz{_named(ear, words)} --stream tf")
    return ok("tf", rates)


def _no_transforms_check(ear: Ear, words: RosMessages) -> Check:
    topic, writers = words.topic(ear.info.name, "tf"), ear.writers("tf")
    if not writers:
        text = f"nobody publishes {topic}: no node makes transforms of the joints"
        return broken("tf", text, _publish(ear, words))
    nodes = _listed(str(writer) for writer in writers)
    if not ear.nodes["joint_states"].writers:
        return skipped("tf", f"{nodes} announced on {topic}, and joint_states to make it of do not come")
    text = f"{nodes} announced on {topic}, but no message comes"
    return broken("tf", text, f"zstate hz{_named(ear, words)} --stream tf")


def _silent_node(ear: Ear, heard: Mapping[int, WriterSamples]) -> str:
    """Which node said something and has stopped; "" for none."""
    for session, node in heard.items():
        if node.statistics.is_stale():
            silent_ns = round(node.statistics.silent_s() * 1e9)
            return f"{_node(ear, session)} has said nothing for {format_duration(silent_ns)}"
    return ""


def _rates_text(ear: Ear, nodes: StreamSamples) -> str:
    return ", ".join(
        f"{'one message' if node.rate_hz is None else rate_text(node.rate_hz)} from {_node(ear, session)}"
        for session, node in nodes.writers.items()
    )


def _node(ear: Ear, session: int) -> str:
    names = {writer.session: str(writer) for _, writer in ear.info.writers}
    return names.get(session, "a node that is not announced")


def _listed(names: Iterable[str], most: int | None = None) -> str:
    """Names as a person is told them: each once, the first ``most`` of them."""
    counted = [name if count == 1 else f"{name} ({count} of them)" for name, count in Counter(names).items()]
    more = f" and {len(counted) - most} more" if most is not None and len(counted) > most else ""
    return ", ".join(counted[:most]) + more
