"""An arm for tests of URDF errors, and the findings of parse_urdf."""

import pytest

from zstate.errors import ModelError
from zstate.model.urdf import parse_urdf

# A table's bodies begin in line 2 of the document: line 1 is the <robot> tag.
ARM = """\
<link name="base"/>
<link name="upper"/>
<link name="lower"/>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
  <axis xyz="0 0 1"/><limit lower="-1" upper="2" velocity="3" effort="4"/></joint>
<joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/></joint>
"""


def robot(body: str) -> str:
    return f'<robot name="arm">\n{body}</robot>'


def joint(
    name: str = "more", kind: str = "fixed", parent: str = "lower", child: str = "tip", inner: str = ""
) -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{inner}</joint>\n'


def tip(kind: str, inner: str = "") -> str:
    """The arm with one more link in line 9 and one more joint in line 8."""
    return ARM + joint(kind=kind, inner=inner) + '<link name="tip"/>\n'


def refusal(text: str | bytes) -> ModelError:
    with pytest.raises(ModelError) as caught:
        parse_urdf(text, "arm.urdf")
    return caught.value


def errors(text: str | bytes) -> list[tuple[int | None, str]]:
    return [(f.line, f.message) for f in refusal(text).findings if f.severity == "error"]


def warnings(text: str) -> list[tuple[int | None, str]]:
    return [(f.line, f.message) for f in parse_urdf(text, "arm.urdf").findings]
