"""The live view of a rollout: `RecordEpisodes(..., live="rerun")` or `live="foxglove"`.

<<<<<<< HEAD
The recorder only starts a process (`session`) and names its files to it. That process (`__main__`) reads the growing
recording as any reader can (`follow`, `new_rows`, `episodes`), and shows new steps: in Rerun, with the same panels as
for finished recordings (`rerun_view`, `rerun_panels`, `rerun_env`), or as a server for Foxglove (`foxglove_view`).
=======
target                                 what `live=` says
session                                starts the process that shows; tells it which files there are
follow, new_rows, episodes             that process (`__main__`) follows the recording as any reader could
rerun_view, rerun_panels, rerun_env    shows what is new in Rerun, with the panels of a replay
foxglove_view                          or serves it to Foxglove
>>>>>>> bd9ab79 (Doors name every room and module)
"""

from tupli_mcap.viewer.live.session import LiveSession, open_session

__all__ = ["LiveSession", "open_session"]
