"""The routes of a server, each a few lines over `Library`.

callers      the caller of a request
accounts     signing in, users, groups, roles, tokens
items        benchmarks and artifacts
episodes     episodes: listed, counted, published, deleted
query        episodes of any recordings as one recording
recordings   recordings: sent, fetched
bodies       the bytes of an answer, whole or a range
operation    health and metrics
viewers      an episode as a file for Rerun; the routes for Foxglove's remote data loader
pytupli      PyTupli's own routes
"""
