"""Panels of images, grids, heat maps and camera frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.messages.frames import EncodedFrame
from tupli_mcap.viewer.blocks import Block
from tupli_mcap.viewer.panels.panel import LeafPanel, Root, side_by_side
from tupli_mcap.viewer.sdk import pa, rr, rrb
from tupli_mcap.viewer.sending import Times, blob_array, column_of, pooled, send_blobs, send_tensors

_MOST_COLUMNS, _MOST_ROWS = 2048, 512  # of a heat map; more are pooled
# By dimensions of a leaf. The viewer knows height and width by these names, and would lay other ones on their side.
_AXES = {2: ("row", "column"), 3: ("[0]", "height", "width")}
_FRAMES_AT_ONCE = 64
_FRAMES_A_LINE = 4  # of a stack, at most
_CHANNELS = (1, 3, 4)
_ATARI = (84, 84, 4)  # four frames, if nothing declares what the channels are


def is_image(shape: Sequence[int]) -> bool:
    """Whether a shape is that of one image: height, width and channels."""
    return len(shape) == 3 and shape[2] in _CHANNELS


@dataclass(frozen=True)
class Picture(LeafPanel):
    """An image leaf: one picture a step. A stack shows all its frames side by side, the newest first.

    `black` and `white` are the values shown as black and white, for leaves that are not uint8.
    """

    black: float = 0.0
    white: float = 255.0

    def declare(self, place: Root) -> None:
        height, width, channels = self._tiled(np.empty((1, *self.leaf.shape), np.uint8)).shape[1:]
        model = {1: rr.ColorModel.L, 3: rr.ColorModel.RGB, 4: rr.ColorModel.RGBA}[channels]
        form = rr.components.ImageFormat(width, height, color_model=model, channel_datatype="U8")
        nearest = rr.components.MagnificationFilter.Nearest
        image = rr.Image.from_fields(format=form, magnification_filter=nearest)
        place.stream.log(place.root + self.entity, image, static=True)

    def send(self, place: Root, block: Block, times: Times) -> None:
        pictures = self._tiled(self._bytes(self.values(block)))
        values = np.ascontiguousarray(pictures).reshape(len(pictures), -1)
        send_blobs(place.stream, place.root + self.entity, times, rr.Image.descriptor_buffer(), values)

    def _bytes(self, values: Array) -> Array:
        if values.dtype == np.uint8:
            return values
        shades = (values.astype(np.float32) - self.black) * (255.0 / (self.white - self.black))
        pictures: Array = np.nan_to_num(shades, nan=0.0).clip(0.0, 255.0).round().astype(np.uint8)
        return pictures

    def _tiled(self, values: Array) -> Array:
        """Pictures (rows x height x width x channels) of a column; black where the last line of a stack is not full."""
        leaf = self.leaf
        if len(leaf.shape) == 2:
            return values[..., None]
        if not self._is_stack:
            return values
        frames = (np.moveaxis(values, -1, 1) if self._frames_last else values)[:, ::-1]
        rows, count, height, width = frames.shape[:4]
        across = min(math.ceil(math.sqrt(count)), _FRAMES_A_LINE)
        down = -(-count // across)
        tiles = np.zeros(
            (rows, down * across, height, width, leaf.size // (count * height * width)), np.uint8
        )
        tiles[:, :count] = frames.reshape(rows, count, height, width, -1)
        lines = tiles.reshape(rows, down, across, height, width, -1).swapaxes(2, 3)
        return lines.reshape(rows, down * height, across * width, -1)

    @property
    def _frames_last(self) -> bool:
        return self.leaf.frames_last or self.leaf.shape == _ATARI

    @property
    def _is_stack(self) -> bool:
        shape = self.leaf.shape
        return len(shape) > 2 and (self._frames_last or self.leaf.kind == "stack" or not is_image(shape))

    def view(self, roots: Sequence[str], axis: Any) -> Any:
        title = self.title
        if self._is_stack:
            count = self.leaf.shape[-1 if self._frames_last else 0]
            title = f"{title}: {count} frames, the newest first"
        return side_by_side(rrb.Spatial2DView, title, roots, self.entity)


@dataclass(frozen=True)
class Grid(LeafPanel):
    """A leaf of two or three dimensions: a tensor a step."""

    def send(self, place: Root, block: Block, times: Times) -> None:
        values = self.values(block)
        kind = np.uint8 if values.dtype == np.uint8 else np.float32
        tensors, axes = list(values.astype(kind, copy=False)), _AXES[len(self.leaf.shape)]
        send_tensors(place.stream, place.root + self.entity, times, tensors, axes)

    def view(self, roots: Sequence[str], axis: Any) -> Any:
        return _tensors(self.title, roots, self.entity)


@dataclass(frozen=True)
class HeatMap(LeafPanel):
    """Many dimensions of a leaf over the steps of an episode: one picture for each episode, at its first step.

    low, high: the range of each dimension, which its colours span.
    """

    low: Array
    high: Array

    def send(self, place: Root, block: Block, times: Times) -> None:
        scaled = self._scaled(self.flat(block))
        maps = [_pooled(scaled[piece.begin : piece.end].T) for piece in block.pieces]
        at = times.at(np.array([piece.begin for piece in block.pieces]))
        send_tensors(place.stream, place.root + self.entity, at, maps, ("dimension", "step"))

    def send_map(self, place: Root, values: Array, times: Times) -> None:
        """Sends one map of `values` (steps x dimensions) for the one time of `times`."""
        maps = [_pooled(self._scaled(values).T)]
        send_tensors(place.stream, place.root + self.entity, times, maps, ("dimension", "step"))

    def _scaled(self, values: Array) -> Array:
        """From 0 (the lowest value of the dimension) to 1 (the highest)."""
        span = np.where(self.high > self.low, self.high - self.low, 1.0).astype(np.float32)
        with np.errstate(invalid="ignore", over="ignore"):
            scaled: Array = np.clip(
                (values.astype(np.float32) - self.low.astype(np.float32)) / span, 0.0, 1.0
            )
        return scaled

    def view(self, roots: Sequence[str], axis: Any) -> Any:
        return _tensors(self.title, roots, self.entity)


def value_range(values: Array) -> tuple[Array, Array]:
    """The lowest and highest finite value of each dimension (steps x dimensions); inf and -inf if it has none."""
    finite = np.isfinite(values)
    low: Array = np.where(finite, values, np.inf).min(axis=0, initial=np.inf)
    high: Array = np.where(finite, values, -np.inf).max(axis=0, initial=-np.inf)
    return low, high


def _pooled(values: Array) -> Array:
    """Means of neighbours, so that no side is longer than a heat map can be."""
    for axis, most in enumerate((_MOST_ROWS, _MOST_COLUMNS)):
        values, _ = pooled(values, most, axis)
    return np.ascontiguousarray(values, np.float32)


@dataclass(frozen=True)
class Camera:
    """The frames of a camera, as they were encoded. They show states."""

    name: str
    entity: str
    title: str
    column: str = "states"

    def declare(self, place: Root) -> None:
        """Sends nothing: everything is sent with the frames."""

    def send(self, place: Root, block: Block, times: Times) -> None:
        if self.name not in block.recording.cameras:  # of another recording in the same view
            return
        for piece in block.pieces:
            frames = block.recording.frames(piece.position, self.name)
            steps = frames.steps
            chosen = np.flatnonzero((steps >= piece.step) & (steps < piece.step + piece.end - piece.begin))
            for few in np.array_split(chosen, -(-len(chosen) // _FRAMES_AT_ONCE)) if len(chosen) else ():
                at = times.at(steps[few] - piece.step + piece.begin)
                self.send_frames(place, [frames.encoded(int(i)) for i in few], at)

    def send_frames(self, place: Root, frames: Sequence[EncodedFrame], times: Times) -> None:
        """Sends one frame a row."""
        ends = np.cumsum([0, *(len(frame.data) for frame in frames)])
        blobs = blob_array(np.frombuffer(b"".join(frame.data for frame in frames), np.uint8), ends)
        kinds = pa.array([f"image/{frame.form}" for frame in frames], pa.utf8())
        columns = [
            column_of(rr.EncodedImage.descriptor_blob(), blobs),
            column_of(rr.EncodedImage.descriptor_media_type(), kinds),
        ]
        place.stream.send_columns(place.root + self.entity, times.columns, columns)

    def view(self, roots: Sequence[str], axis: Any) -> Any:
        return side_by_side(rrb.Spatial2DView, self.title, roots, self.entity)


def _tensors(title: str, roots: Sequence[str], entity: str) -> Any:
    colors = rrb.TensorScalarMapping(colormap="viridis", mag_filter="nearest")
    return side_by_side(rrb.TensorView, title, roots, entity, scalar_mapping=colors, view_fit="fill")
