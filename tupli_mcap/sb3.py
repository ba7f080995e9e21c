"""`tupli_mcap.sb3.VecRecordEpisodes` records vector environments of Stable-Baselines3."""

from tupli_mcap.wrappers.sb3 import VecRecordEpisodes

__all__ = ["VecRecordEpisodes"]
