"""Which journal areas a layout needs."""

from __future__ import annotations

from tupli_mcap.journal.file import FRAMES_AREA, Area, LogArea, RowArea
from tupli_mcap.journal.rows import rows_per_half
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.write.rows.single import CHUNKS_PER_HALF

_HALF = 8 << 20  # bytes of images in half a journal


def plan_areas(
    layout: StepLayout,
    n: int,
    size: int,
    step_capacity: int,
    *,
    vector: bool,
    infos: bool,
    frames: bool = False,
) -> list[Area]:
    """The areas of a journal for `n` sub-environments (of a `vector` environment) and chunks of `size` bytes.

    `step_capacity` is the least room (bytes) for steps of variable size.
    """
    if n > 1:  # one chunk a sub-environment: smaller ones, but never below 64 KiB
        size = max(64 * 1024, size // n)
    areas: list[Area] = []
    if not layout.constant:
        areas += [LogArea(f"steps/{i}", max(size, step_capacity), 2) for i in range(n)]
    else:
        row = layout.step_message.record_size
        chunks = 1 if vector else CHUNKS_PER_HALF
        areas.append(RowArea("steps", row, chunks * rows_per_half(row, size), n))
    for leaf in layout.images:
        row = layout.image_messages[leaf.name].dtype.itemsize
        # of a stack, most rows store one frame
        stored = row // leaf.stored_shape[0] if leaf.kind == "stack" else row
        # some images a chunk: what is done once a chunk takes as long for few of them as for many; of many
        # sub-environments fewer, for the room that their journals take
        some, within = (32, 3 << 20) if n == 1 else (16, 2 << 20)
        rows = rows_per_half(stored, max(size, min(some * stored, within)))
        rows = max(1, min(rows, _HALF // row))
        areas += [RowArea(f"{leaf.name}/{i}", row, rows) for i in range(n)]
    areas.append(LogArea("events", 512 * 1024))
    if infos:
        areas.append(LogArea("info", size))
    if frames:  # pictures are large: a few a chunk
        areas += [LogArea(f"{FRAMES_AREA}{i}", 4 * size) for i in range(n)]
    return areas
