"""Watching a rollout in a viewer while it is recorded: `RecordEpisodes(..., live="rerun")`."""

from tupli_mcap.live.session import LiveSession, open_session

__all__ = ["LiveSession", "open_session"]
