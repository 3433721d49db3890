"""Metrics of drivers, which `zstate monitor --metrics` serves."""

from __future__ import annotations

from helpers.processes import DEADLINE_S, repeated, until
from helpers.prometheus_text import collected, row

from zstate.driving import Commander
from zstate.driving.cli.metrics import DriverMetrics
from zstate.net.streams import KeyPublisher
from zstate.wire.messages import JointState
from zstate.wire.native import encoding_of


def test_a_driver_has_its_state_refused_commands_and_the_age_of_the_newest(sessions, host_driver):
    host = host_driver()
    with (
        DriverMetrics(sessions[1], "*") as metrics,
        Commander(sessions[1], "arm") as commander,
    ):
        commander.wait_for_driver(DEADLINE_S)
        with repeated(lambda: commander.send({"elbow": 0.1})):
            until(lambda: host.state == "active")
        publisher = KeyPublisher(sessions[1], "zstate/arm/joint_commands", encoding_of(JointState))
        until(lambda: publisher.put(b"") or host.report().refused.get("foreign"))
        refused = row("zstate_driver_refused_total", robot="arm", reason="foreign")
        until(lambda: collected(metrics.add).get(refused))
        rows = collected(metrics.add)
        host.close()
        off = row("zstate_driver_state", robot="arm", state="off")
        until(lambda: collected(metrics.add)[off])
        ended = collected(metrics.add)
    assert rows[row("zstate_driver_ticks_total", robot="arm")] > 0.0
    assert rows[row("zstate_driver_command_age_seconds", robot="arm")] > 0.0
    assert 0.0 <= rows[row("zstate_driver_transit_excess_seconds", robot="arm")] < 1.0
    states = [value for (name, _), value in ended.items() if name == "zstate_driver_state"]
    assert sorted(states) == [0.0] * 6 + [1.0]
