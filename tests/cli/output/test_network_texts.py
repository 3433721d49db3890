"""Texts from the network stay on their line: they can imitate no line of a command's output."""

from __future__ import annotations

import pytest

from zstate.cli.commands.monitor import _driver_text
from zstate.cli.doctor.check import Check, check_text, conclusion_text
from zstate.cli.output.joint_state_text import yaml_text
from zstate.driving.driver_state import ReceivedState
from zstate.driving.errors import MotionRefused
from zstate.driving.messages import DriverState, MotionOutcome, state_text

FORGED = "x\nok       all is well\r\x1b[2J"
STATE = DriverState(
    stamp=0,
    session=1,
    program=FORGED,
    state="stopped",
    reason=FORGED,
    joint_names=("elbow",),
    ttl=1,
    commander=FORGED,
    limited=(FORGED,),
    refused={FORGED: 1},
    last_refusal=FORGED,
    outcomes=(MotionOutcome(1, 1, "aborted", FORGED),),
)
ACTIVE = DriverState(0, 1, FORGED, "active", FORGED, (), 1, FORGED)


@pytest.mark.parametrize(
    "text",
    [
        state_text(STATE),
        state_text(ACTIVE),
        str(ReceivedState(STATE, 0.0)),
        str(ReceivedState(STATE, 60.0)),
        ReceivedState(STATE, 0.0).last_motion,
        _driver_text(ReceivedState(STATE, 0.0)),
        MotionRefused("arm", [FORGED]).findings[0],
        check_text(Check("driver", "broken", FORGED, FORGED)).replace("\x1b", ""),  # print_result escapes it
        conclusion_text([Check("driver", "broken", FORGED, FORGED)]).partition("\n")[2],
        yaml_text(FORGED),
    ],
)
def test_a_text_of_a_driver_stays_on_one_line(text: str):
    assert "all is well" in text
    assert len(text.splitlines()) == 1
    assert "\x1b" not in text


def test_findings_of_a_refused_motion_have_a_line_each():
    lines = str(MotionRefused("arm", [FORGED, "too fast"])).splitlines()
    assert len(lines) == 3
    assert lines[1].startswith("  x\\nok")
