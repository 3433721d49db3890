"""parse_urdf: sizes beyond the stated limits are refused with value and limit, and quickly."""

import time
from collections.abc import Callable

from helpers.urdf_text import ARM, errors, joint, robot

from zstate.model.urdf import MAX_LINKS, MAX_VELOCITIES, parse_urdf
from zstate.model.xml import MAX_BYTES, MAX_NESTING


def chain(count: int, kind: str = "fixed") -> str:
    links = "".join(f'<link name="l{i}"/>\n' for i in range(count))
    return robot(links + "".join(joint(f"j{i}", kind, f"l{i}", f"l{i + 1}") for i in range(count - 1)))


def growth(text: Callable[[int], str], size: int) -> float:
    """The computing time of ``text(4 * size)`` in that of ``text(size)``, the least of three each."""

    def cpu_s(whole: str) -> float:
        started = time.thread_time()
        errors(whole)
        return time.thread_time() - started

    small, large = text(size), text(4 * size)
    times = [(cpu_s(small), cpu_s(large)) for _ in range(3)]
    return min(one for _, one in times) / min(one for one, _ in times)


BELOW_QUADRATIC = 8.0
"""Four times the size takes four times as long, or sixteen times if each element looks at all others."""


def test_ten_thousand_links_are_refused_in_a_time_that_grows_with_their_number():
    assert errors(chain(10_000)) == [(None, f"the robot has 10000 links; the limit is {MAX_LINKS}")]
    assert growth(chain, 2_500) < BELOW_QUADRATIC


def test_a_deep_chain_is_refused_and_the_deepest_allowed_is_not():
    assert len(parse_urdf(chain(501), "chain").joints) == 500
    assert errors(chain(502)) == [(None, "link 'l501' lies 501 joints below the root; the limit is 500")]


def test_velocities_have_a_limit_in_which_mimics_count():
    assert parse_urdf(chain(MAX_VELOCITIES + 1, "continuous"), "chain").velocity_count == MAX_VELOCITIES
    one_more = chain(MAX_VELOCITIES + 2, "continuous")
    for text in (one_more, one_more.replace('child link="l1"/>', 'child link="l1"/><mimic joint="j1"/>')):
        assert errors(text) == [(None, f"the robot has 201 velocities; the limit is {MAX_VELOCITIES}")]


def test_xml_nesting_and_size_have_limits():
    deep = robot(ARM + "<a>" * MAX_NESTING + "</a>" * MAX_NESTING)
    ((line, message),) = errors(deep)
    assert (line, message) == (8, "<a> is nested deeper than 100 levels")
    ((line, message),) = errors(" " * (MAX_BYTES + 1))
    assert (line, message) == (None, f"the text has {MAX_BYTES + 1} bytes; the limit is {MAX_BYTES}")
    assert "more than 200000 elements" in errors(robot("<a/>" * 200_000))[0][1]


def test_many_faults_take_a_time_that_grows_with_their_number():
    def faulty(count: int) -> str:
        links = "".join(f'<link name="{"arm_segment" * 5}_{i}"/>' for i in range(count))
        lost = (joint(f"j{i}", "fixed", "arm_segmnt" * 5, f"{'arm_segmnt' * 5}{i}") for i in range(count))
        return robot(links + "".join(lost))

    assert len(errors(faulty(MAX_LINKS // 4))) == MAX_LINKS // 2
    assert growth(faulty, MAX_LINKS // 16) < BELOW_QUADRATIC


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
