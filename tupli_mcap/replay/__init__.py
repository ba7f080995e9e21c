"""Runs recorded episodes again in their rebuilt environment, and compares them bit for bit.

`certify` does this for a recording and returns a `Certificate`; `render` also keeps the frames that the environment
renders. `starts` decides how each episode is started, `reapply` resets and steps the environment, `compare` compares
with `recorded_values`, `attempt` does these three for one episode, `movie` keeps frames and writes films.
`recorded_film` makes films of recorded pictures, and executes nothing.
"""

from tupli_mcap.replay.certificate import Certificate, Counts, Divergence, Skipped
from tupli_mcap.replay.certify import certify
from tupli_mcap.replay.recorded_film import Film, film, has_pictures
from tupli_mcap.replay.render import RenderedEpisode, RenderReport, render

__all__ = [
    "Certificate",
    "Counts",
    "Divergence",
    "Film",
    "RenderReport",
    "RenderedEpisode",
    "Skipped",
    "certify",
    "film",
    "has_pictures",
    "render",
]
