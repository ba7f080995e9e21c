"""Recordings replayed: the environment rebuilt, every episode taken again, and compared bit for bit."""

from tupli_mcap.replay.certificate import Certificate, Counts, Divergence, Skipped
from tupli_mcap.replay.certify import certify

__all__ = ["Certificate", "Counts", "Divergence", "Skipped", "certify"]
