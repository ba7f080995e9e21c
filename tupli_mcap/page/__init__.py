"""The page: recordings in a browser, of a directory, one file, or a server.

shelf, directory    what is shown: the seam, and the shelves of this machine
datasets            recordings put together by what was recorded
routes/, answers    the addresses; pages as HTML and JSON, their headers and errors
curves, charts      what is drawn of an episode, and how
pictures            frames and images
texts               numbers and times for people
app                 `tupli-mcap browse`
templates/, static/ pages, their style and their script
"""
