"""The live view of a rollout: `RecordEpisodes(..., live="rerun")` or `live="foxglove"`.

The recorder only starts a process (`session`) and tells it which files there are. That process (`__main__`) follows the
recording as any reader could (`follow`, `new_rows`, `episodes`) and shows what is new: in Rerun, with the panels of a
replay (`rerun_view`, `rerun_panels`, `rerun_env`), or as a server for Foxglove (`foxglove_view`).
"""

from tupli_mcap.viewer.live.session import LiveSession, open_session

__all__ = ["LiveSession", "open_session"]
