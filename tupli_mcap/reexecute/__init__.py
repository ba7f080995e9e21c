"""Runs recorded episodes again in their rebuilt environment, and compares them bit for bit.

certify, certificate      takes a whole recording again, and says in a `Certificate` what agreed
starts                    how each episode is started again
reapply, compare          resets and steps the environment; compares what it returns with the recorded values
attempt                   the three together, for one episode
render, movie             keeps what the environment renders, too; writes it as a film
recorded_film             a film of recorded pictures, for which nothing is executed
"""

from tupli_mcap.reexecute.certificate import Certificate, Counts, Divergence, Skipped
from tupli_mcap.reexecute.certify import certify
from tupli_mcap.reexecute.recorded_film import Film, film, has_pictures
from tupli_mcap.reexecute.render import RenderedEpisode, RenderReport, render

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
