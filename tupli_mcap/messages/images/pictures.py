"""Encodes and decodes PNG and JPEG with Pillow, which is in the extra `frames`."""

from __future__ import annotations

import io
from typing import Any, Final, Literal, get_args

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, RecordingError, missing_extra

FrameFormat = Literal["png", "jpeg"]
ImageFormat = Literal["raw", "png"]  # of image leaves of the state
Picture = np.ndarray[Any, np.dtype[np.uint8]]
"""uint8 (height, width, 3): red, green, blue."""

_MAGIC: Final = {"png": b"\x89PNG\r\n\x1a\n", "jpeg": b"\xff\xd8\xff"}
_MAX_PIXELS: Final = 1 << 26  # of a picture in a file, whose size is a claim
_QUALITY: Final = 90


def check_format(name: str) -> FrameFormat:
    """The name of a format of frames. Raises RecordingError if it is neither "png" nor "jpeg", MissingExtraError if
    Pillow is not installed."""
    if name not in ("png", "jpeg"):
        raise RecordingError(f"frame_format: expected 'png' or 'jpeg', found {name!r:.40}")
    pillow()
    return "png" if name == "png" else "jpeg"


def check_image_format(name: str) -> None:
    """Raises RecordingError if a format for images of states is neither "raw" nor "png", MissingExtraError if it needs
    Pillow, which is not installed."""
    if name not in ("raw", "png"):
        raise RecordingError(f"image_format: expected 'raw' or 'png', found {name!r:.40}")
    if name == "png":
        pillow()


def pillow() -> Any:
    """The module `PIL.Image`; raises MissingExtraError if Pillow is not installed."""
    try:
        from PIL import Image
    except ImportError as err:
        raise missing_extra("pictures need Pillow", "frames") from err
    return Image


def check_picture(value: Any, where: str) -> Picture:
    """The picture that an environment rendered, checked; raises RecordingError if it is no uint8 array of shape
    (height, width, 3)."""
    if isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.shape[2:] == (3,) and value.size:
        return value
    found = f"{value.dtype} of shape {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
    raise RecordingError(
        f"{where}: expected render() to return a picture (uint8, height x width x 3), found {found}"
    )


def encode_picture(picture: Picture, form: FrameFormat) -> bytes:
    """A picture as a PNG, which is exact, or as a JPEG, which is not."""
    if form == "png":
        return encode_pixels(picture)
    out = io.BytesIO()
    pillow().fromarray(picture).save(out, "JPEG", quality=_QUALITY)
    return out.getvalue()


def decode_picture(data: bytes | memoryview, where: str) -> Picture:
    """The picture in the bytes of a PNG or a JPEG. Raises FormatError if they are neither, or claim more than 2^26
    pixels, MissingExtraError if Pillow is not installed."""
    image_module = pillow()
    try:
        with image_module.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            width, height = image.size
            if width * height > _MAX_PIXELS:
                raise FormatError(f"{where}: the picture claims {width} x {height} pixels")
            return np.asarray(image.convert("RGB"))
    except FormatError:
        raise
    except Exception as err:  # Pillow's decoders raise many kinds
        raise FormatError(f"{where}: expected a PNG or a JPEG, found {_unread(data, err)}") from err


def encode_pixels(pixels: Array) -> bytes:
    """uint8 pixels, (height, width, 1 or 3 or 4), as a PNG, which is exact."""
    flat = pixels[:, :, 0] if pixels.shape[2] == 1 else pixels
    out = io.BytesIO()
    pillow().fromarray(np.ascontiguousarray(flat)).save(out, "PNG", compress_level=1)
    return out.getvalue()


def decode_pixels(data: bytes, shape: tuple[int, int, int], most: int = 1) -> Array:
    """The pixels of a PNG that holds 1 to `most` pictures of shape (height, width, channels), one below the other.
    Raises FormatError if it is no PNG, or has another size, depth or kind, MissingExtraError if Pillow is not
    installed."""
    image_module = pillow()
    height, width, channels = shape
    sizes = {(width, n * height) for n in range(1, most + 1)}
    mode = {1: "L", 3: "RGB", 4: "RGBA"}[channels]
    try:
        with image_module.open(io.BytesIO(data), formats=("PNG",)) as image:
            kind = image.tile[0][3]  # as in the file: `mode` also stands for 16 bits a channel
            if image.size not in sizes or (kind, image.mode) != (mode, mode):
                heights = f"{height}" if most == 1 else f"1 to {most} times {height}"
                raise FormatError(
                    f"expected a PNG of {mode}, {width} x {heights} pixels, found {kind}, "
                    f"{image.width} x {image.height}"
                )
            return np.asarray(image).reshape(-1, width, channels)
    except FormatError:
        raise
    except Exception as err:  # Pillow's decoders raise many kinds
        raise FormatError(f"expected a PNG, found {_unread(data, err)}") from err


def _unread(data: bytes | memoryview, err: Exception) -> str:
    """The first bytes of what is no picture, and Pillow's reason, unless it only says that it does not know them."""
    found = repr(bytes(data[:16]))
    return found if isinstance(err, pillow().UnidentifiedImageError) else f"{found}: {err}"


def format_of(data: bytes | memoryview) -> FrameFormat | None:
    """The format that the first bytes show; None if they are neither a PNG's nor a JPEG's."""
    head = bytes(data[:8])
    return next((name for name in get_args(FrameFormat) if head.startswith(_MAGIC[name])), None)


def resized(picture: Picture, width: int, height: int | None = None) -> Picture:
    """The picture scaled to a width (pixels); without `height` it keeps its proportions."""
    if height is None:
        height = max(1, round(picture.shape[0] * width / picture.shape[1]))
    if picture.shape[:2] == (height, width):
        return picture
    image_module = pillow()
    image = image_module.fromarray(picture).resize((width, height), image_module.Resampling.LANCZOS)
    return np.asarray(image)
