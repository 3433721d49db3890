"""Checks of the ROS nodes in one namespace, where any number of nodes may publish a topic."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace

from zstate.cli.doctor.check import Check, broken, ok, skipped, warning
from zstate.cli.doctor.clock_checks import stamps_check
from zstate.cli.doctor.robot_checks import (
    limits_check,
    measured_checks,
    model_check,
    poses_check,
    refused_check,
    statics_check,
)
from zstate.cli.doctor.robot_probe import RobotProbe
from zstate.cli.output.console import count_text, rate_text
from zstate.cli.output.wire_text import RosMessages
from zstate.errors import format_duration
from zstate.model.robot import RobotModel
from zstate.streams import StreamName

_MAX_NAMES = 6


def ros_checks(probe: RobotProbe, messages: RosMessages, model_name: str) -> Iterator[Check]:
    """The checks of what ``probe`` has collected; ``model_name`` is the expected model, "*" for any."""
    for check in _RosChecks(probe, messages).run(model_name):
        yield replace(check, text=messages.translate(check.text), next=messages.translate(check.next))


class _RosChecks:
    def __init__(self, probe: RobotProbe, messages: RosMessages) -> None:
        self._probe, self._messages = probe, messages
        self._robot = probe.argument
        self._publish = "zstate publish FILE" + (f" --name {probe.info.name}" if self._robot else "")
        self._by_node = {stream: nodes.writers for stream, nodes in probe.nodes.items()}

    def run(self, model_name: str) -> Iterator[Check]:
        probe, writers = self._probe, self._probe.writers("robot_description")
        if len(writers) < 2:
            yield ok("writers", probe.writers_text())
        else:
            listed = _listed(map(str, writers))
            text = f"{len(writers)} nodes publish the model, {listed}: readers use the newest"
            yield warning("writers", text, "zstate ls  # stop one of them, or give each robot a namespace")
        if probe.is_silent and not any(self._by_node.values()):
            names = _listed(dict.fromkeys(str(writer) for _, writer in probe.info.writers))
            why = "no node publishes, or the router denies reading"
            yield broken("writers", f"{names} announced, but no message arrives: {why}", "zstate ls")
            return
        if probe.is_place:
            yield from probe.plugin_checks()
            yield statics_check(probe)
            return
        model, check = self._model_check(model_name)
        yield check
        yield from probe.plugin_checks()
        nodes, publishers = self._by_node["joint_states"], self._by_node["tf"]
        yield self._joints_check(model) if nodes else self._no_joints_check(model)
        yield self._transforms_check() if publishers else self._no_transforms_check()
        yield from measured_checks(probe)
        yield stamps_check(probe)
        if model is not None:
            yield from limits_check(probe, model, nodes.values(), f"zstate echo{self._robot}")
        yield statics_check(probe)
        yield poses_check(probe, model)

    def _model_check(self, name: str) -> tuple[RobotModel | None, Check]:
        probe, topic = self._probe, self._topic("robot_description")
        if not (probe.description or probe.writers("robot_description") or self._by_node["tf"]):
            return None, broken("model", f"{topic} has no publisher", self._publish)
        model, check = model_check(probe)
        if model is None or name in ("*", probe.info.name, model.name):
            return model, check
        text = f"{topic} carries {model.name!r}, not {name!r}; {check.text}"
        return model, warning("model", text, "zstate ls  # shows the domain and namespace of each node")

    def _joints_check(self, model: RobotModel | None) -> Check:
        """Whether one node publishes each joint of ``model``; other joints are allowed."""
        topic, echo = self._topic("joint_states"), f"zstate echo{self._robot} --once"
        rates, silent = self._rates("joint_states")
        if silent:
            hz = f"zstate hz{self._robot} --stream joint_states"
            return broken("joint_states", f"{silent}; all nodes: {rates}", hz)
        if model is None:
            return ok("joint_states", rates)
        names = self._names("joint_states")
        missing = [repr(name) for name in model.joint_names if name not in names]
        others = [repr(name) for name in names if name not in model.joint_names]
        if len(missing) == len(model.joint_names):
            found = _listed(map(repr, names), _MAX_NAMES)
            text = f"no joint on {topic} ({found}) is in the model {model.name!r}: {rates}"
            return broken("joint_states", text, f"{echo}  # and compare it with `zstate check FILE`")
        for name in model.joint_names:
            if len(nodes := names.get(name, ())) > 1:
                text = f"joint {name!r} is published by {_listed(nodes)}: poses will jump between them"
                return warning("joint_states", f"{text}; {rates}", "zstate ls  # stop one of them")
        if missing:
            count, found = count_text(len(missing), "joint"), _listed(missing, _MAX_NAMES)
            text = f"{count} of the model without a publisher: {found}; {rates}"
            return warning("joint_states", text, f"{echo}  # shows the published joints")
        if others:
            rates += f"; {count_text(len(others), 'joint')} outside the model: {_listed(others, _MAX_NAMES)}"
        return ok("joint_states", rates)

    def _no_joints_check(self, model: RobotModel | None) -> Check:
        probe, topic = self._probe, self._topic("joint_states")
        if writers := probe.writers("joint_states"):
            text = f"{_listed(map(str, writers))} announced on {topic}, but no message arrives"
            return broken("joint_states", text, f"zstate hz{self._robot} --stream joint_states")
        if self._by_node["tf"]:
            return skipped("joint_states", f"{topic} has no publisher; the poses are published on tf")
        if model is not None and not model.joint_names:
            return ok("joint_states", "the model has no moving joint")
        waiting = probe.writers("tf") or probe.writers("robot_description")
        waits = f", and {waiting[-1]} waits for it" if waiting else ""
        text = f"{topic} has no publisher{waits}: the robot's driver is not running"
        return broken("joint_states", text, "zstate joints FILE  # moves it, until the driver runs")

    def _transforms_check(self) -> Check:
        refused = refused_check(self._probe)
        if refused is not None:
            return refused
        rates, silent = self._rates("tf")
        for child, nodes in self._names("tf").items():
            if len(nodes) > 1:
                text = f"{child!r} is placed by {_listed(nodes)}: it jumps between them; {rates}"
                return warning("tf", text, "zstate ls  # stop one of them, or give each robot a namespace")
        if silent:
            return warning("tf", f"{silent}; all nodes: {rates}", f"zstate hz{self._robot} --stream tf")
        return ok("tf", rates)

    def _no_transforms_check(self) -> Check:
        topic, nodes = self._topic("tf"), _listed(map(str, self._probe.writers("tf")))
        if not nodes:
            text = f"{topic} has no publisher: no node computes transforms from joint states"
            return broken("tf", text, self._publish)
        if not self._by_node["joint_states"]:
            return skipped("tf", f"{nodes} announced on {topic}, but no joint_states arrive for it")
        text = f"{nodes} announced on {topic}, but no message arrives"
        return broken("tf", text, f"zstate hz{self._robot} --stream tf")

    def _topic(self, stream: StreamName) -> str:
        return self._messages.topic(self._probe.info.name, stream)

    def _names(self, stream: StreamName) -> dict[str, list[str]]:
        """The joints or child frames on a topic, each with the nodes that publish it."""
        names: dict[str, list[str]] = {}
        for session, node in self._by_node[stream].items():
            for name in node.names:
                names.setdefault(name, []).append(self._probe.writer_name(session))
        return names

    def _rates(self, stream: StreamName) -> tuple[str, str]:
        """The rate of each node on a topic; and the first one that has stopped publishing, or ""."""
        texts, silent = list[str](), ""
        for session, node in self._by_node[stream].items():
            name, window = self._probe.writer_name(session), node.statistics.window()
            rate_hz = None if window is None else window.rate_hz
            texts.append(f"{'one message' if rate_hz is None else rate_text(rate_hz)} from {name}")
            if not silent and node.statistics.is_stale():
                duration = format_duration(round(node.statistics.silent_s() * 1e9))
                silent = f"{name} has published nothing for {duration}"
        return ", ".join(texts), silent


def _listed(names: Iterable[str], most: int | None = None) -> str:
    """Each name once, with its count; at most ``most`` of them."""
    counted = [name if count == 1 else f"{name} ({count} of them)" for name, count in Counter(names).items()]
    more = f" and {len(counted) - most} more" if most is not None and len(counted) > most else ""
    return ", ".join(counted[:most]) + more
