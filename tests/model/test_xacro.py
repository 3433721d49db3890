"""Xacro: expanded if a package for it is installed, otherwise an error that names the package."""

from pathlib import Path

import pytest

from zstate.errors import ModelError
from zstate.model import xacro_expansion
from zstate.model.load import load_model

NAMESPACE = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
ARM = f"""<robot name="arm" {NAMESPACE}>
  <xacro:arg name="length" default="1"/>
  <xacro:include filename="parts/tip.xacro"/>
  <link name="base"/>
  <xacro:tip length="$(arg length)"/>
</robot>"""
TIP = f"""<robot {NAMESPACE}><xacro:macro name="tip" params="length">
  <link name="tip"/>
  <joint name="end" type="fixed">
    <parent link="base"/><child link="tip"/><origin xyz="${{2 * length}} 0 0"/>
  </joint>
</xacro:macro></robot>"""


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "tip.xacro").write_text(TIP)
    path = tmp_path / "arm.urdf.xacro"
    path.write_text(ARM)
    return path


def test_a_xacro_file_is_expanded_with_its_includes_and_arguments(arm: Path):
    pytest.importorskip("xacro")
    assert load_model(arm).joints[0].origin[0] == 2.0
    assert load_model(arm, xacro_args={"length": "3"}).joints[0].origin[0] == 6.0


def test_each_distinct_warning_of_xacro_is_one_finding_and_nothing_is_printed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    pytest.importorskip("xacro")
    path = tmp_path / "warning.xacro"
    macro = (
        '<xacro:macro name="part" params="n">${xacro.warning("old macro")}<link name="l${n}"/></xacro:macro>'
    )
    uses = "".join(f'<xacro:part n="{number}"/>' for number in range(3))
    redefined = '<xacro:property name="pi" value="3"/>'
    joints = "".join(
        f'<joint name="j{n}" type="fixed"><parent link="l0"/><child link="l{n}"/></joint>' for n in (1, 2)
    )
    path.write_text(f'<robot name="r" {NAMESPACE}>{macro}{redefined}{uses}{joints}</robot>')
    model = load_model(path)
    assert sorted(finding.message for finding in model.findings) == [
        "xacro: old macro (warning.xacro), 3 times",
        "xacro: redefining global symbol: pi (warning.xacro)",
    ]
    assert {finding.severity for finding in model.findings} == {"warning"}
    assert capfd.readouterr() == ("", "")


def test_an_argument_that_the_file_does_not_use_is_a_finding_with_its_near_miss(arm: Path):
    pytest.importorskip("xacro")
    assert load_model(arm, xacro_args={"length": "3"}).findings == ()
    (finding,) = load_model(arm, xacro_args={"lenght": "3"}).findings
    assert finding.message == "the xacro argument 'lenght' is not used by the file; did you mean 'length'?"


def test_findings_of_an_expanded_file_refer_to_lines_of_the_expansion(tmp_path: Path):
    pytest.importorskip("xacro")
    path = tmp_path / "empty.xacro"
    path.write_text(f'<robot name="r" {NAMESPACE}/>')
    with pytest.raises(ModelError, match=r"empty.xacro \(expanded\) cannot be used"):
        load_model(path)


@pytest.mark.parametrize(
    ("inner", "words"),
    [
        ('<link name="${1/0}"/><xacro:if value="0"/>', "division by zero"),
        ('<xacro:nosuchmacro name="x"/>', "nosuchmacro"),
        ('<xacro:include filename="gone.xacro"/>', "gone.xacro"),
        ('<xacro:include filename="$(find no_such_package)/a.xacro"/>', "packages are found by"),
    ],
)
def test_a_failed_expansion_has_its_cause_in_one_line(inner: str, words: str):
    pytest.importorskip("xacro")
    with pytest.raises(ModelError) as caught:
        load_model(f'<robot name="r" {NAMESPACE}>{inner}</robot>')
    (finding,) = caught.value.findings
    assert finding.message.startswith("xacro could not expand it: ")
    assert words in finding.message
    assert "\n" not in finding.message


@pytest.mark.parametrize(
    ("inner", "limit", "words"),
    [
        ('<link name="${9**9**9}"/>', "_CPU_S", "takes more than 30 s of CPU"),
        ("<link name=\"${'%1000000000d' % 1 * 3}\"/>", "_MEMORY_BYTES", "needs more than 2 GiB of memory"),
    ],
)
@pytest.mark.long
def test_an_expansion_has_limits_of_time_and_memory(inner: str, limit: str, words: str, monkeypatch):
    pytest.importorskip("xacro")
    # A smaller limit in the process of the expansion; the texts keep the shipped one.
    small = {"_CPU_S": 1, "_MEMORY_BYTES": 1 << 29}[limit]
    lower = f"import zstate.model.xacro_expansion as expansion\nexpansion.{limit} = {small}\nanswer_request("
    program = xacro_expansion._PROGRAM.replace("answer_request(", lower)
    monkeypatch.setattr(xacro_expansion, "_PROGRAM", program)
    with pytest.raises(ModelError, match=words):
        load_model(f'<robot name="r" {NAMESPACE}><xacro:if value="0"/>{inner}</robot>')


@pytest.mark.parametrize(
    "inner",
    ["<link name=\"${'x' * 17000000}\"/>", "<link name=\"a\"/>${xacro.warning('x' * 17000000)}"],
    ids=["text", "warning"],
)
def test_an_expansion_returns_no_more_text_than_a_model_may_have(inner: str):
    pytest.importorskip("xacro")
    with pytest.raises(ModelError, match="its expansion has more than 16777216 characters") as caught:
        load_model(f'<robot name="r" {NAMESPACE}><xacro:if value="0"/>{inner}</robot>')
    assert len(str(caught.value)) < 1000


def test_the_environment_and_the_folder_add_no_modules_to_an_expansion(
    tmp_path: Path, arm: Path, monkeypatch
):
    pytest.importorskip("xacro")
    (tmp_path / "json.py").write_text("raise SystemExit('imported')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert load_model(arm).joints[0].origin[0] == 2.0


def test_without_a_xacro_package_the_error_names_the_extra_to_install(
    arm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for name in ("xacro", "xacrodoc"):
        (tmp_path / f"{name}.py").write_text("raise ImportError")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModelError, match=r"pip install 'zstate\[xacro\]'"):
        load_model(arm)
