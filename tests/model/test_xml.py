"""read_document: bytes that are not trustworthy XML are refused with place and cause."""

import codecs

import pytest

from zstate.errors import ModelError
from zstate.model.urdf import parse_urdf
from zstate.model.xml import Document
from zstate.model.xml import read_document as read_text
from zstate.model.xml_text import decode

SMALL = '<robot name="\u00e9"><link name="a"/></robot>'

LAUGHS = """<?xml version="1.0"?>
<!DOCTYPE robot [
<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">
]>
<robot name="&b;"><link name="a"/></robot>"""


def read_document(data: str | bytes, source: str) -> Document:
    return read_text(data if isinstance(data, str) else decode(data, source), source)


def finding(data: str | bytes) -> tuple[int | None, str]:
    with pytest.raises(ModelError) as caught:
        read_document(data, "small.urdf")
    (only,) = caught.value.findings
    return only.line, only.message


@pytest.mark.parametrize("empty", ["", b"", "  \n ", b"\xef\xbb\xbf"])
def test_empty_text_is_reported_as_empty(empty: str | bytes):
    assert finding(empty) == (None, 'the text is empty; a URDF begins with <robot name="...">')


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("<robot>\n <link>\n</robot>", 3, "</robot> closes <link>, which was opened in line 2"),
        ("<robot>\n<a></a></robot></robot>", 2, "after </robot>"),
        ("<robot>\n <link", 2, "the file ends inside <robot>, which was opened in line 1; is it truncated?"),
        ("<robot>\n <link>\n", 3, "the file ends inside <link>, which was opened in line 2"),
        ("<robot/>\n<robot/>", 2, "a second <robot>; the first begins in line 1"),
        ("<robot/>\n<other/>", 2, "there is something after </robot>"),
        ('<robot>\n<a b="1" b="2"/></robot>', 2, "duplicate attribute"),
        ('<robot>\n<a b="&nosuch;"/></robot>', 2, "undefined entity"),
        ("not XML at all", 1, "column 1: malformed XML"),
        ("\n\n<robot>\n<\x01/>", 4, "malformed XML"),
    ],
)
def test_malformed_xml_has_line_column_and_cause(text: str, line: int, words: str):
    for data in (text, text.encode()):
        at, message = finding(data)
        assert at == line
        assert words in message


@pytest.mark.parametrize(
    "text",
    [
        LAUGHS,
        '<!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/hostname">]><robot name="&x;"/>',
        '<!DOCTYPE robot SYSTEM "http://127.0.0.1/robot.dtd"><robot name="a"/>',
        '<!DOCTYPE robot [<!ENTITY % p "x">]><robot name="a"/>',
        '<!DOCTYPE robot [<!ATTLIST link name CDATA "x">]><robot name="a"><link/></robot>',
    ],
)
def test_entities_and_foreign_files_are_refused(text: str):
    _, message = finding(text)
    assert message.startswith("a DOCTYPE with declarations (entities) or a reference to a file is refused")


def test_binary_data_is_reported_as_binary():
    assert finding(b"<robot>\n\x7fELF\0\0")[1].endswith("a zero byte; this is a binary file, not a URDF")


def test_latin_1_without_a_declaration_has_line_column_and_advice():
    data = f"<!-- top -->\n{SMALL}".encode("latin-1")
    assert finding(data) == (
        2,
        "column 14: byte 0xe9 is not UTF-8; save the file as UTF-8, or declare its encoding in line 1 "
        '(<?xml version="1.0" encoding="ISO-8859-1"?>)',
    )


@pytest.mark.parametrize(
    "data",
    [
        SMALL,
        SMALL.encode(),
        codecs.BOM_UTF8 + SMALL.encode(),
        codecs.BOM_UTF16_LE + SMALL.encode("utf-16-le"),
        codecs.BOM_UTF16_BE + SMALL.encode("utf-16-be"),
        b'<?xml version="1.0" encoding="ISO-8859-1"?>' + SMALL.encode("latin-1"),
        b"<?xml version='1.0' encoding='windows-1252'?>" + SMALL.encode("cp1252"),
        '<?xml version="1.0" encoding="ISO-8859-1"?>' + SMALL,
    ],
)
def test_text_reads_the_same_in_every_encoding(data: str | bytes):
    assert read_document(data, "small.urdf").root.attributes["name"] == "\u00e9"


def test_codec_that_is_not_a_text_encoding_is_refused():
    data = b'<?xml version="1.0" encoding="rot13"?><robot/>'
    assert finding(data) == (1, "the declared encoding 'rot13' is not read; save the file as UTF-8")


def test_half_a_surrogate_pair_is_refused():
    assert finding("<robot>\n<a b='\ud800'/></robot>")[0] == 2


def test_lines_include_leading_blanks_which_the_model_drops():
    model = parse_urdf("\n\n" + SMALL, "small.urdf")
    assert model.urdf == SMALL
    assert read_document("\n\n" + SMALL, "small.urdf").root.line == 3
