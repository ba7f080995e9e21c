"""Steps by number, and items made of them: windows, transitions, the values around a step.

steps                          the interface that items read from; steps in memory
beside                         the fields infos and frames; infos as columns
recorded, index, segments      reads steps from recordings, by `recording.columns`; finds them; finds their chunks
kept                           caches decoded columns
items                          the base of windows, transitions and delta windows; reads them in batches, also ahead
windows, transitions, deltas   the three kinds of items
order, draws                   numbers of items: each once an epoch, or drawn by weight
shuffle                        an order that reads each chunk about once, also over workers and ranks
"""

from tupli_mcap.dataset.items.deltas import DeltaWindow, DeltaWindows, Unit
from tupli_mcap.dataset.items.draws import Sampler
from tupli_mcap.dataset.items.index import ListedEpisodes
from tupli_mcap.dataset.items.items import Batches, Items, Samples
from tupli_mcap.dataset.items.order import Numbers, Order
from tupli_mcap.dataset.items.recorded import RecordedSteps, steps_of
from tupli_mcap.dataset.items.steps import FIELDS, MemorySteps, SamplingError, Steps
from tupli_mcap.dataset.items.transitions import Transition, Transitions
from tupli_mcap.dataset.items.windows import Pad, Window, Windows

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
    "Samples",
    "SamplingError",
    "Steps",
    "Transition",
    "Transitions",
    "Unit",
    "Window",
    "Windows",
    "steps_of",
]
