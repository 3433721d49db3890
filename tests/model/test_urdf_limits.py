"""parse_urdf: sizes beyond the stated limits are refused with value and limit, and quickly."""

import gc
import time
from collections.abc import Callable

import pytest
from helpers.urdf_text import ARM, errors, joint, robot

from zstate.model.urdf import parse_urdf

MIB = 2**20


def chain(count: int, kind: str = "fixed") -> str:
    links = "".join(f'<link name="l{i}"/>\n' for i in range(count))
    return robot(links + "".join(joint(f"j{i}", kind, f"l{i}", f"l{i + 1}") for i in range(count - 1)))


def growth(text: Callable[[int], str], size: int) -> float:
    """The computing time of ``text(4 * size)`` in that of ``text(size)``, the least of three each."""

    def cpu_s(whole: str) -> float:
        gc.disable()  # it looks at all objects of the tests
        started = time.thread_time()
        errors(whole)
        took_s = time.thread_time() - started
        gc.enable()
        return took_s

    small, large = text(size), text(4 * size)
    times = [(cpu_s(small), cpu_s(large)) for _ in range(3)]
    return min(one for _, one in times) / min(one for one, _ in times)


BELOW_QUADRATIC = 8.0
"""Four times the size takes four times as long, or sixteen times if each element looks at all others."""


@pytest.mark.long
def test_ten_thousand_links_are_refused_in_a_time_that_grows_with_their_number():
    assert errors(chain(10_000)) == [(None, "the robot has 10000 links; the limit is 2000")]
    assert growth(chain, 2_500) < BELOW_QUADRATIC


def star(count: int) -> str:
    links = "".join(f'<link name="l{i}"/>\n' for i in range(count))
    return robot(links + "".join(joint(f"j{i}", "fixed", "l0", f"l{i}") for i in range(1, count)))


def test_a_robot_has_2000_links_at_most():
    assert len(parse_urdf(star(2000), "star").links) == 2000
    assert errors(star(2001)) == [(None, "the robot has 2001 links; the limit is 2000")]


def test_a_deep_chain_is_refused_and_the_deepest_allowed_is_not():
    assert len(parse_urdf(chain(501), "chain").joints) == 500
    assert errors(chain(502)) == [(None, "link 'l501' lies 501 joints below the root; the limit is 500")]


def test_velocities_have_a_limit_in_which_mimics_count():
    assert parse_urdf(chain(201, "continuous"), "chain").velocity_count == 200
    one_more = chain(202, "continuous")
    for text in (one_more, one_more.replace('child link="l1"/>', 'child link="l1"/><mimic joint="j1"/>')):
        assert errors(text) == [(None, "the robot has 201 velocities; the limit is 200")]


@pytest.mark.long
def test_xml_nesting_and_size_have_limits():
    deep = robot(ARM + "<a>" * 100 + "</a>" * 100)
    ((line, message),) = errors(deep)
    assert (line, message) == (8, "<a> is nested deeper than 100 levels")
    largest = robot(ARM)
    largest += " " * (16 * MIB - len(largest))
    assert parse_urdf(largest, "arm")
    assert errors(largest + " ") == [(None, "the text has 16777217 bytes; the limit is 16777216")]
    assert "more than 200000 elements" in errors(robot("<a/>" * 200_000))[0][1]


@pytest.mark.long
def test_many_faults_take_a_time_that_grows_with_their_number():
    def faulty(count: int) -> str:
        links = "".join(f'<link name="{"arm_segment" * 5}_{i}"/>' for i in range(count))
        lost = (joint(f"j{i}", "fixed", "arm_segmnt" * 5, f"{'arm_segmnt' * 5}{i}") for i in range(count))
        return robot(links + "".join(lost))

    assert len(errors(faulty(500))) == 1000
    assert growth(faulty, 125) < BELOW_QUADRATIC


def test_a_mimic_chain_has_a_limit():
    links = "".join(f'<link name="l{i}"/>' for i in range(102))
    joints = [
        joint(
            f"j{i}", "continuous", "base", f"l{i}", f'<mimic joint="{"elbow" if i == 0 else f"j{i - 1}"}"/>'
        )
        for i in range(102)
    ]
    found = errors(robot(ARM + links + "".join(joints)))
    assert [message for _, message in found] == ["joint 'j100' ends a chain of 101 mimics; the limit is 100"]
