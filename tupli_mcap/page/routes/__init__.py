"""The addresses of the page.

lists      `/`: datasets; `/episodes`: tables of episodes
dataset    `/dataset/KEY`: one of them
episode    `/episode/ID`: one episode
chosen     `/compare`, `/download`
viewer     `/viewer`: episodes in Rerun
files      pictures, style sheet and scripts
"""

from tupli_mcap.page.routes import chosen, dataset, episode, files, lists, viewer

__all__ = ["PAGES"]

PAGES = (lists.router, dataset.router, episode.router, chosen.router, viewer.router, files.router)
