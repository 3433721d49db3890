"""Map files: every mode by map_server's formulas, what is refused, and what is written.

Expected cells are derived from the formulas at https://wiki.ros.org/map_server, in a comment beside each.
"""

import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image

from zstate import InvalidInput, Transform
from zstate.errors import LibraryMissing
from zstate.scans import Grid, load_map
from zstate.scans.map_files import MAX_CELLS

# p = 1 - s / 255 of these greys, rounded: 1, 0.78, 0.6, 0.4, 0.2, 0.196, 0.004, 0.
GREYS = [0, 55, 102, 153, 204, 205, 254, 255]


def write_yaml(folder: Path, **changes: str) -> Path:
    values = {
        "image": "hall.png",
        "resolution": "0.05",
        "origin": "[-1.0, 2.5, 0.0]",
        "negate": "0",
        "occupied_thresh": "0.65",
        "free_thresh": "0.196",
        **changes,
    }
    path = folder / "hall.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in values.items() if value))
    return path


def write_image(folder: Path, pixels: object, name: str = "hall.png") -> None:
    Image.fromarray(np.asarray(pixels)).save(folder / name)


def row_of(folder: Path, pixels: list[object], dtype: type = np.uint8, **changes: str) -> list[int]:
    """The cells of a map whose image has one row."""
    write_image(folder, np.array([pixels], dtype=dtype))
    return load_map(write_yaml(folder, **changes)).cells[0].tolist()


# The modes


def test_trinary_is_occupied_free_or_unknown(tmp_path: Path):
    # Above 0.65: 1 and 0.78. Below 0.196: 0.004 and 0; 205 has 50/255 = 0.19608, which is not below.
    assert row_of(tmp_path, GREYS) == [100, 100, -1, -1, -1, -1, 0, 0]


def test_a_pixel_at_a_threshold_is_between_them(tmp_path: Path):
    # 1 - 102/255 = 0.6 and 1 - 153/255 = 0.4 are neither above 0.6 nor below 0.4.
    thresholds = {"occupied_thresh": "0.6", "free_thresh": "0.4"}
    assert row_of(tmp_path, [101, 102, 153, 154], **thresholds) == [100, -1, -1, 0]
    assert row_of(tmp_path, [101, 102, 153, 154], **thresholds, mode="scale") == [100, 100, 0, 0]


def test_negate_makes_white_occupied(tmp_path: Path):
    # p = s / 255: 0, 0.22, 0.4, 0.6, 0.8, 0.804, 0.996, 1.
    assert row_of(tmp_path, GREYS, negate="1") == [0, -1, -1, -1, 100, 100, 100, 100]
    assert row_of(tmp_path, GREYS, negate="true") == row_of(tmp_path, GREYS, negate="1")


def test_scale_is_linear_between_the_thresholds(tmp_path: Path):
    # 100 (p - 0.2) / (0.8 - 0.2): 55 has p = 0.78431 -> 97.39; 102 0.6 -> 66.67; 153 0.4 -> 33.33.
    changes = {"mode": "scale", "occupied_thresh": "0.8", "free_thresh": "0.2"}
    assert row_of(tmp_path, GREYS, **changes) == [100, 97, 67, 33, 0, 0, 0, 0]
    # With p = s / 255: 55 0.21569 -> 2.61; 102 0.4 -> 33.33; 153 0.6 -> 66.67; 204 0.8 -> 100.
    assert row_of(tmp_path, GREYS, **changes, negate="1") == [0, 3, 33, 67, 100, 100, 100, 100]


def test_raw_is_the_pixel_whatever_the_thresholds(tmp_path: Path):
    for changes in ({}, {"negate": "1"}, {"occupied_thresh": "1.0", "free_thresh": "0.0"}):
        cells = row_of(tmp_path, [0, 1, 99, 100, 101, 127, 128, 255], mode="raw", **changes)
        assert cells == [0, 1, 99, 100, -1, -1, -1, -1]


def test_trinary_averages_alpha_in(tmp_path: Path):
    # s = (r + g + b + alpha) / 4 / 255.
    pixels = [
        (0, 0, 0, 255),  # s = 1/4, p = 0.75
        (0, 0, 0, 128),  # s = 0.1255, p = 0.87
        (255, 255, 255, 255),  # p = 0
        (255, 255, 255, 0),  # s = 3/4, p = 0.25
        (128, 128, 128, 255),  # s = 0.6265, p = 0.37
    ]
    assert row_of(tmp_path, pixels) == [100, 100, 0, -1, -1]


def test_scale_has_unknown_cells_where_a_pixel_is_not_opaque(tmp_path: Path):
    pixels = [(0, 0, 0, 255), (0, 0, 0, 254), (255, 255, 255, 0), (128, 128, 128, 255)]
    changes = {"mode": "scale", "occupied_thresh": "1.0", "free_thresh": "0.0"}
    # p of 128 is 0.498.
    assert row_of(tmp_path, pixels, **changes) == [100, -1, -1, 50]


def test_raw_ignores_alpha(tmp_path: Path):
    assert row_of(tmp_path, [(7, 7, 7, 0), (7, 7, 7, 255)], mode="raw") == [7, 7]


def test_colors_are_averaged(tmp_path: Path):
    # s = (255 + 0 + 0) / 3 / 255 = 1/3 for each of red, green and blue, whose luminance differs.
    changes = {"mode": "scale", "occupied_thresh": "1.0", "free_thresh": "0.0"}
    assert row_of(tmp_path, [(255, 0, 0), (0, 255, 0), (0, 0, 255)], **changes) == [67, 67, 67]


def test_grey_of_16_bits_has_the_same_scale(tmp_path: Path):
    # s = value / 65535; 13107 is a fifth: p = 0.8. Raw: 255 * 10000 / 65535 = 38.9.
    changes = {"mode": "scale", "occupied_thresh": "1.0", "free_thresh": "0.0"}
    assert row_of(tmp_path, [0, 13107, 65535], np.uint16, **changes) == [100, 80, 0]
    assert row_of(tmp_path, [0, 10000, 65535], np.uint16, mode="raw") == [0, 39, -1]


@pytest.mark.parametrize("kind", ["1", "P", "LA", "RGB", "RGBA"])
@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
def test_black_and_white_are_the_same_in_every_kind_of_image(tmp_path: Path, kind: str, mode: str):
    write_yaml(tmp_path, mode=mode)
    Image.fromarray(np.array([[0, 255]], np.uint8)).convert(kind).save(tmp_path / "hall.png")
    # Opaque black with alpha has s = 1/4, p = 0.75, which is above 0.65 as well.
    expected = [0, -1] if mode == "raw" else [100, 0]
    assert load_map(tmp_path / "hall.yaml").cells[0].tolist() == expected


@pytest.mark.parametrize("name", ["hall.pgm", "hall.bmp", "hall.png"])
def test_the_top_row_of_the_image_has_the_largest_y(tmp_path: Path, name: str):
    write_image(tmp_path, np.array([[0, 255], [255, 255], [255, 255]], np.uint8), name)
    grid = load_map(write_yaml(tmp_path, image=name, resolution="1.0", origin="[0, 0, 0]"))
    assert grid.cells.tolist() == [[0, 0], [0, 0], [100, 0]]
    assert grid.at([[0.5, 2.5], [0.5, 0.5]]).tolist() == [100, 0]


def test_the_yaw_of_the_origin_is_honoured(tmp_path: Path):
    write_image(tmp_path, np.array([[255, 0]], np.uint8))
    grid = load_map(write_yaml(tmp_path, resolution="1.0", origin=f"[10, 20, {np.pi / 2}]"))
    # Columns run along y: the second one is from y = 21 to 22, left of the corner, from x = 9 to 10.
    assert grid.at([[9.5, 20.5], [9.5, 21.5], [10.5, 21.5]]).tolist() == [0, 100, -1]
    assert grid.planar_origin() == pytest.approx((10.0, 20.0, np.pi / 2))


def test_a_map_of_several_strips_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("zstate.scans.map_files._STRIP_CELLS", 10)
    pixels = np.random.default_rng(1).integers(0, 101, (7, 4)).astype(np.uint8)
    write_image(tmp_path, pixels)
    assert load_map(write_yaml(tmp_path, mode="raw")).cells.tolist() == pixels[::-1].tolist()


def test_metadata_is_read_and_other_keys_are_ignored(tmp_path: Path):
    write_image(tmp_path, np.array([[255]], np.uint8))
    grid = load_map(write_yaml(tmp_path, building="hall", mode="Trinary"), frame="odom")
    assert grid.resolution == 0.05
    assert grid.frame == grid.origin.target == "odom"
    assert grid.planar_origin() == (-1.0, 2.5, 0.0)


def test_images_are_found_from_the_folder_of_the_yaml(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "images").mkdir()
    write_image(tmp_path / "images", np.array([[0]], np.uint8))
    path = write_yaml(tmp_path, image="images/hall.png")
    monkeypatch.chdir(tmp_path.parent)
    assert load_map(str(path.relative_to(tmp_path.parent))).cells.tolist() == [[100]]
    write_yaml(tmp_path, image=str(tmp_path / "images" / "hall.png"))
    assert load_map(path).cells.tolist() == [[100]]


# What is refused


def findings(path: Path) -> list[str]:
    """The findings, without the folder."""
    with pytest.raises(InvalidInput) as caught:
        load_map(path)
    return str(caught.value).replace(f"{path.parent}/", "").splitlines()


@pytest.mark.parametrize(
    ("changes", "finding"),
    [
        ({"free_thresh": "0.9"}, "6: free_thresh 0.9 is above occupied_thresh 0.65: free cells are below"),
        ({"free_thresh": "0.65"}, "6: free_thresh 0.65 is equal to occupied_thresh 0.65"),
        ({"occupied_thresh": "65"}, "5: occupied_thresh is an occupancy from 0 to 1, not 65; 65 % is 0.65"),
        ({"free_thresh": "-0.1"}, "6: free_thresh is an occupancy from 0 to 1, not -0.1"),
        ({"free_thresh": "nan"}, "6: free_thresh is a finite number, not 'nan'"),
        ({"resolution": "0"}, "2: resolution is the side of a cell [m], above zero; not 0"),
        ({"resolution": "5cm"}, "2: resolution is a finite number, not '5cm'"),
        ({"resolution": "[0.05]"}, "2: resolution is a finite number, not ['0.05']"),
        ({"origin": "[0, 0]"}, "3: origin is a list of three numbers, [x, y, yaw]"),
        ({"origin": "[0, 0, [1]]"}, "3: origin is a finite number, not ''"),
        ({"origin": "{x: 0, y: 0, yaw: 0}"}, "3: origin is a list of three numbers"),
        (
            {"origin": "[0, 0, 90]"},
            "3: origin has a yaw of 90 rad, more than a full turn. If it is in degrees, ",
        ),
        ({"negate": "maybe"}, "4: negate is 0 or 1, not 'maybe'"),
        ({"mode": "binary"}, "7: mode is one of trinary, scale, raw; not 'binary'"),
        ({"image": "''"}, "1: image is the path of a file"),
        ({"negate": ""}, "1: negate is missing"),
        ({"resolution": "", "resolutoin": "0.05"}, "1: resolution is missing; did you mean 'resolutoin'?"),
    ],
)
def test_a_wrong_value_is_refused_with_its_line(tmp_path: Path, changes: dict[str, str], finding: str):
    write_image(tmp_path, np.array([[0]], np.uint8))
    (text,) = findings(write_yaml(tmp_path, **changes))
    assert text.startswith(f"hall.yaml:{finding}")


def test_every_finding_is_reported_at_once_by_line(tmp_path: Path):
    found = findings(write_yaml(tmp_path, image="none.png", origin="here", free_thresh="2", negate=""))
    assert found == [
        "hall.yaml:1: image 'none.png' is not a file",
        "hall.yaml:1: negate is missing",
        "hall.yaml:3: origin is a list of three numbers, [x, y, yaw] in [m] and [rad]; not 'here'",
        "hall.yaml:5: free_thresh is an occupancy from 0 to 1, not 2; 2 % is 0.02",
    ]


def test_a_missing_image_is_named_by_the_path_that_was_tried(tmp_path: Path):
    with pytest.raises(InvalidInput, match=f"hall.yaml:1: image '{tmp_path}/maps/none.png' is not a file"):
        load_map(write_yaml(tmp_path, image="maps/none.png"))


def test_a_key_given_twice_is_refused(tmp_path: Path):
    write_image(tmp_path, np.array([[0]], np.uint8))
    path = write_yaml(tmp_path)
    path.write_text(path.read_text() + "resolution: 0.1\n")
    assert findings(path) == ["hall.yaml:7: 'resolution' is given twice, first in line 2"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is one mapping with the keys image, resolution"),
        (b"- image\n- resolution\n", "is one mapping"),
        (b"just text", "is one mapping"),
        (b"image: a\n---\nimage: b\n", "is one mapping"),
        (b"image: hall.png\n  resolution: 1\n", "hall.yaml:2: not YAML"),
        (b"image: \x01\n", "not YAML"),
        (b"\x89PNG\r\n\x1a\n\xff", "is not text in UTF-8; name the YAML file of a map, not its image"),
        (b"#" * 9_000, "has more than 8192 bytes"),
        (b"[" * 8_000, "not YAML"),
        (b"- " * 900, "is one mapping"),
        (b"- " * 4_000, "hall.yaml"),
        (b"image: " + b"[" * 900 + b"]" * 900, "image is the path of a file"),
        (b"a: &a [x, x]\nb: &b [*a, *a]\norigin: [*b, *b, *b]\n", "origin is a finite number"),
    ],
)
def test_a_file_that_is_no_map_is_refused(tmp_path: Path, content: bytes, message: str):
    path = tmp_path / "hall.yaml"
    path.write_bytes(content)
    with pytest.raises(InvalidInput, match=message):
        load_map(path)


def test_a_missing_yaml_file_is_refused(tmp_path: Path):
    with pytest.raises(InvalidInput, match=r"hall.yaml cannot be read: No such file or directory"):
        load_map(tmp_path / "hall.yaml")


def png(width: int, height: int, rows: bytes = b"") -> bytes:
    """A PNG of 8-bit grey with any size in its header."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("size", "message"),
    [
        ((16_384, 16_384), f"{MAX_CELLS} cells"),
        ((12_000, 12_000), f"{MAX_CELLS} cells"),
        ((2**31 - 1, 2**31 - 1), f"{MAX_CELLS} cells"),
        ((0, 10), "not an image"),
    ],
)
def test_an_image_of_a_hostile_size_is_refused_before_it_is_decoded(
    tmp_path: Path, size: tuple[int, int], message: str
):
    (tmp_path / "hall.png").write_bytes(png(*size))
    with pytest.raises(InvalidInput, match=message):
        load_map(write_yaml(tmp_path))


@pytest.mark.parametrize("name", ["hall.png", "hall.pgm", "hall.bmp"])
@pytest.mark.filterwarnings("error")
def test_a_truncated_image_is_refused_unless_all_its_pixels_are_there(tmp_path: Path, name: str):
    write_image(tmp_path, np.random.default_rng(1).integers(0, 255, (20, 20)).astype(np.uint8), name)
    content = (tmp_path / name).read_bytes()
    path = write_yaml(tmp_path, image=name)
    whole = load_map(path).cells.tolist()
    refused = 0
    for length in range(0, len(content), 7):
        (tmp_path / name).write_bytes(content[:length])
        try:
            assert load_map(path).cells.tolist() == whole
        except InvalidInput as error:
            assert name in str(error)
            refused += 1
    # A PNG ends with two checksums and an empty chunk, together 20 bytes.
    assert refused >= (len(content) - 20) // 7


def test_a_file_that_is_no_image_is_refused(tmp_path: Path):
    (tmp_path / "hall.png").write_text("<svg/>")
    with pytest.raises(InvalidInput, match=r"hall.png is not an image in the format png, pgm, bmp or jpeg"):
        load_map(write_yaml(tmp_path))


def test_without_pillow_trinary_maps_are_saved_and_the_error_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "PIL", None)
    grid = Grid([[0]], 0.05, (0, 0, 0))
    grid.save(tmp_path / "hall.yaml")
    for call in (lambda: load_map(tmp_path / "hall.yaml"), lambda: grid.save(tmp_path / "x.yaml", "scale")):
        with pytest.raises(LibraryMissing, match=r"images of maps need Pillow: pip install 'zstate\[maps\]'"):
            call()


# Saving

CELLS = arrays.arrays(np.int8, arrays.array_shapes(min_dims=2, max_dims=2), elements=st.integers(-1, 100))
ORIGINS = st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-3.0, 3.0))


@given(CELLS, ORIGINS, st.floats(1e-6, 100.0), st.sampled_from(["scale", "raw"]))
def test_scale_and_raw_keep_every_cell(tmp_path_factory: pytest.TempPathFactory, cells, origin, side, mode):
    path = tmp_path_factory.getbasetemp() / "kept.yaml"
    Grid(cells, side, origin).save(path, mode)
    loaded = load_map(path)
    assert loaded.cells.tolist() == cells.tolist()
    assert loaded.resolution == side
    assert loaded.planar_origin() == pytest.approx(origin, abs=1e-12)


def test_trinary_keeps_what_map_savers_thresholds_call_occupied_and_free(tmp_path: Path):
    Grid([[0, 25, 26, 64, 65, 100, -1]], 0.05, (0, 0, 0)).save(tmp_path / "hall.yaml")
    assert load_map(tmp_path / "hall.yaml").cells.tolist() == [[0, 0, -1, -1, 100, 100, -1]]


def test_files_are_those_of_map_saver(tmp_path: Path):
    grid = Grid([[0, -1], [100, 50]], 0.05, (-1, 2.5, 0))
    grid.save(tmp_path / "hall.yaml")
    assert (tmp_path / "hall.yaml").read_text() == (
        'image: "hall.pgm"\nmode: trinary\nresolution: 0.05\norigin: [-1.0, 2.5, 0.0]\nnegate: 0\n'
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    # 0 is occupied, 254 free, 205 unknown; the top row is the last one.
    assert (tmp_path / "hall.pgm").read_bytes() == b"P5\n2 2\n255\n" + bytes([0, 205, 254, 205])
    grid.save(tmp_path / "scale.yml", mode="scale")
    with Image.open(tmp_path / "scale.png") as image:
        assert np.array_equal(np.asarray(image), grid.to_image())


def test_small_numbers_are_written_without_an_exponent(tmp_path: Path):
    Grid([[0]], 1e-5, (1e-7, 0, 0)).save(tmp_path / "hall.yaml")
    text = (tmp_path / "hall.yaml").read_text()
    assert "resolution: 0.00001\norigin: [0.0000001, 0.0, 0.0]\n" in text


def test_a_map_that_cannot_be_saved_is_refused(tmp_path: Path):
    grid = Grid([[0]], 0.05, (0, 0, 0))
    with pytest.raises(
        InvalidInput, match=r"saved as FILE.yaml, with its image at its side; got '.*hall.pgm'"
    ):
        grid.save(tmp_path / "hall.pgm")
    with pytest.raises(InvalidInput, match="one of trinary, scale, raw; got 'binary'"):
        grid.save(tmp_path / "hall.yaml", "binary")  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match=r"none/hall.pgm cannot be written: No such file or directory"):
        grid.save(tmp_path / "none" / "hall.yaml")


@pytest.mark.parametrize(
    "pose", [((0, 0, 1), (0, 0, 0)), ((0, 0, 0), (0.1, 0, 0)), ((0, 0, 0), (0, -0.1, 0))]
)
def test_an_origin_out_of_the_plane_cannot_be_saved(tmp_path: Path, pose):
    grid = Grid([[0]], 0.05, Transform.from_rpy("map", "corner", *pose))
    with pytest.raises(InvalidInput, match="is not in the x-y plane"):
        grid.save(tmp_path / "hall.yaml")
