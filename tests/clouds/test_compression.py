"""Compression of clouds: exact, or rounded within the stated bound; and no memory for what is promised."""

from __future__ import annotations

import tracemalloc
from typing import Any

import lz4.block
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from zstate.clouds.cloud import Cloud, cloud_from_message, cloud_to_message
from zstate.clouds.compression import Compression, compress, decompress
from zstate.clouds.messages import CLOUD_BYTES, PointCloud, PointField
from zstate.errors import InvalidInput
from zstate.wire.measurements import with_field

COMPRESSIONS = ["lz4", "zstd"]
KIND = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "tag", "time", "normal"],
        "formats": ["<f4", "<f4", "<f8", "<f4", "<u2", "i1", "<f8", ("<i4", (2,))],
        "offsets": [0, 4, 10, 20, 24, 26, 27, 36],
        "itemsize": 48,
    }
)
EACH = pytest.mark.parametrize("compression", COMPRESSIONS)


def same(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether all fields have the same bits."""
    return all(a[name].tobytes() == b[name].tobytes() for name in a.dtype.names or ())


def points(count: int, seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    made = np.zeros(count, KIND)
    for name in ("x", "y", "z", "intensity", "time"):
        made[name] = random.normal(0, 10, count)
    made["ring"], made["tag"] = random.integers(0, 2**16, count), random.integers(-128, 128, count)
    made["normal"] = random.integers(-(2**31), 2**31, (count, 2))
    return made


@EACH
@given(made=hnp.arrays(np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4"), ("i", "i1")]), 7))
def test_without_a_resolution_all_bits_are_kept_nan_and_infinity_too(
    compression: Compression, made: np.ndarray
):
    data = compress(made, compression, 0.0)
    assert same(decompress(data, compression, 0.0, made.dtype, 7), made)


@EACH
def test_gaps_unaligned_fields_and_fields_of_several_numbers_are_kept(compression: Compression):
    made = points(1000)
    assert same(decompress(compress(made, compression, 0.0), compression, 0.0, KIND, 1000), made)


@EACH
@pytest.mark.parametrize("resolution", [0.001, 0.01, 0.3])
def test_a_resolution_changes_coordinates_by_half_of_it_at_most_and_nothing_else(
    compression: Compression, resolution: float
):
    made = points(1000)
    made["x"][[0, 7, 8, 999]] = np.nan
    made["z"][5] = np.inf
    read = decompress(compress(made, compression, resolution), compression, resolution, KIND, 1000)
    for name in "xyz":
        finite = np.isfinite(made[name])
        assert np.isnan(read[name][~finite]).all()
        # and the rounding of the result to the type of the field
        rounding = np.spacing(np.abs(read[name][finite]))
        change = np.abs(read[name][finite].astype(float) - made[name][finite].astype(float))
        assert (change <= resolution / 2 + rounding).all()
    rest = ["intensity", "ring", "tag", "time", "normal"]
    assert same(read[rest], made[rest])


def test_a_cloud_without_a_finite_point_keeps_its_nan():
    made = np.full(9, np.nan, dtype=np.float32).repeat(3).view([(name, "<f4") for name in "xyz"])
    read = decompress(compress(made, "lz4", 0.01), "lz4", 0.01, made.dtype, 9)
    assert np.isnan(read["x"]).all()


def test_coordinates_beyond_the_reach_of_a_resolution_are_refused_with_it():
    made = points(4)
    made["y"][2] = -2e6
    with pytest.raises(InvalidInput, match=r"the y of a point is 2e\+06 m, and a resolution of 0\.001 m"):
        compress(made, "lz4", 0.001)


@st.composite
def damaged(draw: st.DrawFn) -> bytes:
    data = compress(points(50), "lz4", 0.01)
    at = draw(st.integers(0, len(data)))
    return data[:at] + draw(st.binary(max_size=8)) + data[at + draw(st.integers(0, 8)) :]


@given(damaged())
def test_damaged_data_are_other_points_or_refused(data: bytes):
    try:
        assert len(decompress(data, "lz4", 0.01, KIND, 50)) == 50
    except InvalidInput as error:
        assert "no lz4 of" in str(error)


def message(compression: Compression, data: bytes, count: int = 100) -> PointCloud:
    one = cloud_to_message(Cloud(0, "lidar", points(count)), True, compression)
    return with_field(one, "data", data)


BOMBS: dict[str, tuple[Compression, bytes]] = {
    "lz4": ("lz4", lz4.block.compress(bytes(10**9 // 4), store_size=False)),
    "zstd": ("zstd", zstandard.ZstdCompressor().compress(bytes(10**9 // 4))),
    "no zstd": ("zstd", b"no frame"),
    "nothing": ("lz4", b""),
}


@pytest.mark.parametrize("name", BOMBS)
def test_data_that_are_not_the_points_of_the_message_are_refused_before_memory_is_taken(name: str):
    compression, data = BOMBS[name]
    tracemalloc.start()
    try:
        with pytest.raises(InvalidInput, match=f"the compressed points are no {compression} of"):
            cloud_from_message(message(compression, data), "r1")
        assert tracemalloc.get_traced_memory()[1] < 10**6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("row_step", 4801, "rows without padding"),
        ("is_bigendian", True, "little-endian"),
        ("data", bytes(CLOUD_BYTES + 1), "compressed bytes, where"),
        ("resolution", -1.0, "the resolution of a compressed cloud"),
        ("resolution", float("nan"), "the resolution of a compressed cloud"),
        ("fields", (PointField("a", 0, 7, 7), PointField("b", 0, 7, 7)), "do not overlap"),
    ],
)
def test_impossible_compressed_clouds_are_refused(name: str, value: Any, text: str):
    with pytest.raises(InvalidInput, match=text):
        with_field(message("lz4", b""), name, value)


def test_a_cloud_without_points_is_not_compressed():
    assert cloud_to_message(Cloud(0, "lidar", points(0)), True, "lz4", 0.01).compression == ""
