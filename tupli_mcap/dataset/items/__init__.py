"""Steps by number, and what is made of them: windows, transitions, the values around a step.

steps                          what all of these read from; steps in memory
beside                         steps with infos and frames; infos as columns
recorded, index, kept          steps read out of recordings; where they lie; those kept decoded
items                          what windows, transitions and delta windows have in common
windows, transitions, deltas   the three kinds of items
order, draws, sumtree          which items come next: each once an epoch, or drawn by weight
batches                        items read in batches, some of them ahead
"""

from tupli_mcap.dataset.items.batches import Batches
from tupli_mcap.dataset.items.beside import (
    BESIDE,
    FRAMES,
    INFOS,
    FrameValues,
    InfoValues,
    StepsWith,
    info_columns,
)
from tupli_mcap.dataset.items.deltas import DeltaWindow, DeltaWindows, Unit
from tupli_mcap.dataset.items.draws import Sampler
from tupli_mcap.dataset.items.index import ListedEpisodes
from tupli_mcap.dataset.items.items import Items, Samples
from tupli_mcap.dataset.items.order import Numbers, Order
from tupli_mcap.dataset.items.recorded import RecordedSteps, steps_of
from tupli_mcap.dataset.items.steps import FIELDS, MemorySteps, SamplingError, Steps, checked_fields
from tupli_mcap.dataset.items.transitions import Transition, Transitions
from tupli_mcap.dataset.items.windows import Pad, Window, Windows

__all__ = [
    "BESIDE",
    "FIELDS",
    "FRAMES",
    "INFOS",
    "Batches",
    "DeltaWindow",
    "DeltaWindows",
    "FrameValues",
    "InfoValues",
    "Items",
    "ListedEpisodes",
    "MemorySteps",
    "Numbers",
    "Order",
    "Pad",
    "RecordedSteps",
    "Sampler",
    "Samples",
    "SamplingError",
    "Steps",
    "StepsWith",
    "Transition",
    "Transitions",
    "Unit",
    "Window",
    "Windows",
    "checked_fields",
    "info_columns",
    "steps_of",
]
