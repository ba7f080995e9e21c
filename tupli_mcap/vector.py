"""`tupli_mcap.vector.RecordEpisodes` records `gymnasium.vector` environments."""

from tupli_mcap.wrappers.vector import RecordEpisodes

__all__ = ["RecordEpisodes"]
