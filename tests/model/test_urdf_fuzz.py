"""Whatever the text, parse_urdf answers with a model or a ModelError."""

import contextlib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zstate.errors import ModelError
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.model.xml_text import decode

SEED = (Path(__file__).parents[2] / "models" / "gripper.urdf").read_bytes()
TOKENS = [
    b"<",
    b">",
    b'"',
    b"/",
    b"<link",
    b"<joint",
    b"<mimic",
    b"<!--",
    b"&",
    b"\0",
    b"\xff",
    b"nan",
    b" 1e9 ",
]
TAGS = st.sampled_from(
    ["robot", "link", "joint", "parent", "child", "axis", "origin", "limit", "mimic", "xacro:a"]
)
TYPES = ["fixed", "revolute", "continuous", "prismatic", "floating", "planar", "Ball"]
VALUES = st.sampled_from(["a", "b", "c", "", "/a", "${a}", "1 2 3", "0 0 1", "1", "nan", "1,5", *TYPES])
ATTRIBUTES = st.dictionaries(
    st.sampled_from(["name", "type", "link", "joint", "xyz", "rpy", "lower", "upper", "multiplier"]),
    VALUES,
    max_size=4,
)


def element(children: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    def text(tag: str, attributes: dict[str, str], inner: list[str]) -> str:
        written = "".join(f' {name}="{value}"' for name, value in attributes.items())
        return f"<{tag}{written}>{''.join(inner)}</{tag}>"

    return st.builds(text, TAGS, ATTRIBUTES, st.lists(children, max_size=5))


def parse(data: str | bytes) -> None:
    with contextlib.suppress(ModelError):
        model = parse_urdf(data if isinstance(data, str) else decode(data, "fuzz"), "fuzz")
        assert isinstance(model, RobotModel)
        assert all(model.mimic_of(joint).joint in model.columns for joint in model.joints if joint.mimic)
        assert model.neutral.shape == (model.position_count,)
        assert len(model.joints) == len(model.links) - 1


@given(st.one_of(st.binary(), st.text()))
@settings(max_examples=300, deadline=None)
def test_any_bytes_give_a_model_or_a_model_error(data: str | bytes):
    parse(data)


@given(
    st.lists(st.tuples(st.integers(0, len(SEED)), st.integers(0, 40), st.sampled_from(TOKENS)), max_size=6)
)
@settings(max_examples=200, deadline=None)
def test_a_damaged_file_gives_a_model_or_a_model_error(edits: list[tuple[int, int, bytes]]):
    data = SEED
    for start, length, replacement in edits:
        data = data[:start] + replacement + data[start + length :]
    parse(data)


@given(st.lists(st.recursive(st.just(""), element, max_leaves=8), max_size=8))
@settings(max_examples=300, deadline=None)
@pytest.mark.long
def test_well_formed_nonsense_gives_a_model_or_a_model_error(elements: list[str]):
    parse(f'<robot name="r"><link name="a"/>{"".join(elements)}</robot>')
