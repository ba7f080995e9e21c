"""Recorders: `RecordEpisodes` wraps one environment or a vector environment; `EpisodeWriter` and `write_rollout` record
episodes that come from no environment.

single, vector, sb3       records one environment; many; a `VecEnv` of Stable-Baselines3
base                      the base classes of these
episode_writer, streams   `EpisodeWriter`; the episodes of each of its streams
from_arrays               `write_rollout`
rollout                   records a rollout in one call
described                 what a recording says about the environment and the run; which leaves are stacks of frames
"""

from tupli_mcap.wrappers.episode_writer import EpisodeWriter
from tupli_mcap.wrappers.from_arrays import write_rollout
from tupli_mcap.wrappers.single import RecordEpisodes

__all__ = ["EpisodeWriter", "RecordEpisodes", "write_rollout"]
