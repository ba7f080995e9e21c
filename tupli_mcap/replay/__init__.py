"""Replays recordings: rebuilds the environment, takes every episode again, and compares it bit for bit.

`certify` does so for a whole recording and gives a `Certificate`; `render` also keeps what the environment renders.
`starts` decides how each episode is started again, `reapply` resets and steps the environment, `compare` compares with
`recorded_values`, `attempt` is the three together for one episode, `movie` keeps rendered frames and writes films.
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
