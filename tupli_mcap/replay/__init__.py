"""Recordings replayed: the environment rebuilt, every episode taken again, and compared bit for bit."""

from tupli_mcap.replay.certificate import Certificate, Counts, Divergence, Skipped
from tupli_mcap.replay.certify import certify
from tupli_mcap.replay.render import RenderedEpisode, RenderReport, render

__all__ = [
    "Certificate",
    "Counts",
    "Divergence",
    "RenderReport",
    "RenderedEpisode",
    "Skipped",
    "certify",
    "render",
]
