"""The addresses of the page.

lists      `/`: datasets; `/episodes`: tables of episodes
dataset    `/dataset/KEY`: one of them
episode    `/episode/ID`: one episode
files      pictures, and the style and the script of the pages
"""

from tupli_mcap.page.routes import dataset, episode, files, lists

__all__ = ["PAGES"]

PAGES = (lists.router, dataset.router, episode.router, files.router)
