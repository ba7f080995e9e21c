"""The live view of a rollout: `RecordEpisodes(..., live="rerun")` or `live="foxglove"`.

The recorder only starts a process (`session`) and names its files to it. That process (`__main__`) reads the growing
recording as any reader can (`follow`, `new_rows`, `episodes`), and shows new steps: in Rerun, with the same panels as
for finished recordings (`rerun_view`, `rerun_panels`, `rerun_env`), or as a server for Foxglove (`foxglove_view`).
"""

from tupli_mcap.viewer.live.session import LiveSession, open_session

__all__ = ["LiveSession", "open_session"]
