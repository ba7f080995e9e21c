"""The live view of a rollout: `RecordEpisodes(..., live="rerun")` or `live="foxglove"`.

target                                 parses `live=`
session                                starts the process of the view, and names the recording's files to it
follow, new_rows, episodes             read the growing recording in that process (`__main__`), as any reader can
rerun_view, rerun_panels, rerun_env    show new steps in Rerun, with the same panels as for finished recordings
foxglove_view                          serves them to Foxglove
"""

from tupli_mcap.viewer.live.session import LiveSession, open_session

__all__ = ["LiveSession", "open_session"]
