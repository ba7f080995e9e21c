"""Web pages that show the recordings of a directory, of one file, or of a server.

shelf, directory    where recordings come from: the interface, and its versions for this machine
datasets            recordings put together by what was recorded
routes/, answers    the addresses; pages as HTML and JSON, their headers and errors
curves, charts      what is drawn of an episode, and how
pictures            frames, and images of states
samples             what a whole dataset is like
copies              chosen episodes as files
texts               numbers and times for people
app                 `tupli-mcap browse`
templates/, static/ pages, their style and their script
"""
