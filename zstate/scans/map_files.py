"""Map files of map_server: the image with the cells, and the writing of both files.

With s, the mean of red, green and blue from 0 (black) to 1 (white), a pixel has the occupancy p = 1 - s, or
p = s with ``negate``. The modes of https://wiki.ros.org/map_server make cells of it:

- trinary: 100 above ``occupied_thresh``, 0 below ``free_thresh``, else -1. If the image has an alpha channel,
  it is a fourth term of the mean. nav2 does so up to Humble; since Jazzy it has -1 for transparent pixels.
- scale: the same, but 100 (p - free) / (occupied - free), rounded, between the thresholds; -1 for pixels that
  are not opaque.
- raw: 255 s, rounded, and -1 above 100; neither negate nor the thresholds matter.

The first row of an image is the top, the row of the largest y.
"""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zstate.errors import InvalidInput, LibraryMissing
from zstate.scans.map_metadata import MODES, MapMetadata, Mode

MAX_CELLS = 2**27
"""The largest map: for instance 8192 x 16384 cells. Pillow refuses images a little larger than that."""

_STRIP_CELLS = 2**22  # numpy uses 20 bytes for each of the cells that it converts at once
_FORMATS = ("PNG", "PPM", "BMP", "JPEG")  # PPM stands for .pgm, .pbm and .ppm
# The pixels that map_saver writes in trinary mode, and thresholds that tell them apart. The cells that are
# saved as occupied and free are those of its defaults.
_TRINARY_PIXELS = {"occupied": 0, "unknown": 205, "free": 254}
_TRINARY_THRESHOLDS = (0.65, 0.196)
SAVED_OCCUPIED, SAVED_FREE = 65, 25


def read_cells(metadata: MapMetadata) -> NDArray[np.int8]:
    """The cells of a map, (height, width), the row of the smallest y first: -1 or 0 to 100.

    Raises InvalidInput for an image that cannot be decoded or is too large, LibraryMissing without Pillow.
    """
    image = _open_image(metadata.image)
    cells = np.empty((image.height, image.width), dtype=np.int8)
    height = max(1, _STRIP_CELLS // image.width)
    for top in range(0, image.height, height):
        bottom = min(top + height, image.height)
        cells[top:bottom] = _strip_cells(metadata, image.crop((0, top, image.width, bottom)))
    return cells[::-1]


def write_map(
    path: Path,
    cells: NDArray[np.int8],
    resolution: float,
    origin: tuple[float, float, float],
    mode: Mode = "trinary",
) -> None:
    """Write the YAML file and its image, as map_saver does; ``cells`` as in ``read_cells``.

    The image has the name of ``path``, which ends in .yaml or .yml: .png in scale mode, else .pgm. Raises
    InvalidInput if a file cannot be written, LibraryMissing for a .png without Pillow.
    """
    if path.suffix not in (".yaml", ".yml"):
        raise InvalidInput(f"a map is saved as FILE.yaml, with its image at its side; got {str(path)!r}")
    if mode not in MODES:
        raise InvalidInput(f"the mode of a map file is one of {', '.join(MODES)}; got {mode!r}")
    image = path.with_suffix(".png" if mode == "scale" else ".pgm")
    occupied, free = _TRINARY_THRESHOLDS if mode == "trinary" else (1.0, 0.0)
    numbers = ", ".join(map(_decimal, origin))
    text = (
        f"image: {json.dumps(image.name)}\nmode: {mode}\nresolution: {_decimal(resolution)}\n"
        f"origin: [{numbers}]\nnegate: 0\noccupied_thresh: {occupied}\nfree_thresh: {free}\n"
    )
    try:
        if mode == "scale":
            _pillow().fromarray(scale_image(cells)).save(image)
        else:
            header = f"P5\n{cells.shape[1]} {cells.shape[0]}\n255\n".encode()
            image.write_bytes(header + cells[::-1].tobytes().translate(_pixels_by_cell(mode)))
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InvalidInput(f"{error.filename or path} cannot be written: {error.strerror}") from None


def scale_image(cells: NDArray[np.int8]) -> NDArray[np.uint8]:
    """The image of scale mode, RGBA (height, width, 4), its first row the top.

    From white (0) to black (100); unknown cells are transparent grey.
    """
    colors = np.zeros((256, 4), dtype=np.uint8)
    colors[:101, :3] = np.rint(np.linspace(255.0, 0.0, 101))[:, None]
    colors[:101, 3] = 255
    colors[-1] = (128, 128, 128, 0)
    # One integer for the four bytes of a pixel: five times as fast.
    pixels = np.take(colors.view(np.uint32)[:, 0], cells[::-1].view(np.uint8))
    return pixels.view(np.uint8).reshape(*cells.shape, 4)


def _pixels_by_cell(mode: Mode) -> bytes:
    """256 grey values, by the cell as uint8, so that -1 is 255."""
    if mode == "raw":
        return bytes(range(256))
    pixels = bytearray(256 * [_TRINARY_PIXELS["unknown"]])
    pixels[: SAVED_FREE + 1] = (SAVED_FREE + 1) * [_TRINARY_PIXELS["free"]]
    pixels[SAVED_OCCUPIED:101] = (101 - SAVED_OCCUPIED) * [_TRINARY_PIXELS["occupied"]]
    return bytes(pixels)


def _decimal(number: float) -> str:
    """The shortest text of a float, without an exponent: YAML 1.1 has 1e-05 as text."""
    return np.format_float_positional(number, trim="0")


def _cells_by_level(metadata: MapMetadata, white: int) -> NDArray[np.int8]:
    """The cell of each brightness 0 to ``white``: (white + 1,)."""
    shade = np.arange(white + 1) / white
    if metadata.mode == "raw":
        value = np.floor(255.0 * shade + 0.5)
        return np.where(value <= 100.0, value, -1.0).astype(np.int8)
    occupied, free = metadata.occupied_thresh, metadata.free_thresh
    occupancy = shade if metadata.negate else 1.0 - shade
    between = -1.0 if metadata.mode == "trinary" else np.rint((occupancy - free) / (occupied - free) * 100.0)
    cells = np.where(occupancy > occupied, 100.0, np.where(occupancy < free, 0.0, between))
    return cells.astype(np.int8)


def _strip_cells(metadata: MapMetadata, image: Any) -> NDArray[np.int8]:
    """The cells of some rows of the image, its first row first."""
    levels, white, alpha = _levels(image)
    if alpha is not None and metadata.mode == "trinary":
        levels, white = levels + alpha, white + 255
    cells = _cells_by_level(metadata, white)[levels]
    if alpha is not None and metadata.mode == "scale":
        cells[alpha < 255] = -1
    return cells


def _levels(image: Any) -> tuple[NDArray[Any], int, NDArray[np.uint8] | None]:
    """The brightness of each pixel, (height, width); that of white; and alpha if the image has it.

    The brightness is the grey value of 8 or 16 bits, or the sum of red, green and blue.
    """
    if image.mode.startswith("I"):  # 16 bits of grey
        return np.asarray(image).astype(np.uint16), 65535, None
    if image.mode == "L" and "transparency" not in image.info:
        return np.asarray(image), 255, None
    has_alpha = "A" in image.getbands() or "transparency" in image.info
    colors: NDArray[np.uint8] = np.asarray(image.convert("RGBA" if has_alpha else "RGB"))
    return colors[..., :3].sum(axis=-1, dtype=np.uint16), 3 * 255, colors[..., 3] if has_alpha else None


def _open_image(path: Path) -> Any:
    """The decoded image. Raises InvalidInput."""
    module = _pillow()
    try:
        with warnings.catch_warnings(), path.open("rb") as file:
            # Pillow warns of images from two thirds of our limit on, and refuses those above 1.3 times of it.
            warnings.simplefilter("ignore", module.DecompressionBombWarning)
            image = module.open(file, formats=_FORMATS)
            _check_size(path, *image.size)
            image.load()
    except InvalidInput:
        raise
    except module.UnidentifiedImageError:
        raise InvalidInput(f"{path} is not an image in the format png, pgm, bmp or jpeg") from None
    except module.DecompressionBombError as error:
        raise InvalidInput(f"{path} is larger than a map of at most {MAX_CELLS} cells: {error}") from None
    except Exception as error:  # damaged files raise anything: struct.error, zlib.error, SyntaxError, ...
        raise InvalidInput(f"{path} cannot be decoded: {error or type(error).__name__}") from None
    return image


def _check_size(path: Path, width: int, height: int) -> None:
    if not 0 < width * height <= MAX_CELLS:
        raise InvalidInput(f"{path} has {width} x {height} pixels; a map has 1 to {MAX_CELLS} cells")


def _pillow() -> Any:
    """``PIL.Image``. Raises LibraryMissing."""
    try:
        from PIL import Image  # noqa: PLC0415 - loaded when it is needed
    except ImportError:
        command = "pip install 'zstate[maps]'"
        raise LibraryMissing(f"images of maps need Pillow: {command}", command=command) from None
    return Image
