"""Gymnasium wrappers that record: `RecordEpisodes` for one environment, its vector twin for many."""

from tupli_mcap.wrappers.single import RecordEpisodes

__all__ = ["RecordEpisodes"]
