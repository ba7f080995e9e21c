"""What records: Gymnasium wrappers, `RecordEpisodes` for one environment and its vector twin for many, and
`EpisodeWriter` and `write_rollout`, for episodes that come from no environment.

single, vector, sb3       records one environment; many; a `VecEnv` of Stable-Baselines3
base                      what these share
episode_writer, streams   `EpisodeWriter`; the episodes of each of its streams
from_arrays               `write_rollout`
rollout                   a rollout recorded in one call
benchmark, run, stacks    what is noted of the environment; of the run; which leaves are stacks of frames
"""

from tupli_mcap.wrappers.episode_writer import EpisodeWriter
from tupli_mcap.wrappers.from_arrays import write_rollout
from tupli_mcap.wrappers.single import RecordEpisodes

__all__ = ["EpisodeWriter", "RecordEpisodes", "write_rollout"]
