"""Random access to steps: windows, transitions and samplers over recordings, saved columns or memory."""

from tupli_mcap.sampling.batches import Batches
from tupli_mcap.sampling.deltas import DeltaWindow, DeltaWindows, Unit
from tupli_mcap.sampling.draws import Numbers, Order, Sampler
from tupli_mcap.sampling.index import ListedEpisodes
from tupli_mcap.sampling.items import Items
from tupli_mcap.sampling.recorded import RecordedSteps, steps_of
from tupli_mcap.sampling.steps import FIELDS, MemorySteps, SamplingError, Steps
from tupli_mcap.sampling.transitions import Transition, Transitions
from tupli_mcap.sampling.windows import Pad, Window, Windows

__all__ = [
    "FIELDS",
    "Batches",
    "DeltaWindow",
    "DeltaWindows",
    "Items",
    "ListedEpisodes",
    "MemorySteps",
    "Numbers",
    "Order",
    "Pad",
    "RecordedSteps",
    "Sampler",
    "SamplingError",
    "Steps",
    "Transition",
    "Transitions",
    "Unit",
    "Window",
    "Windows",
    "steps_of",
]
