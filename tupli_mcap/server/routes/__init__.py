"""The routes of a server, each a few lines over `Library`.

callers      who asks, in what every route takes
accounts     signing in, users, groups, roles, tokens
items        benchmarks and artifacts
episodes     episodes: listed, counted, published, deleted
query        episodes of any recordings as one recording
recordings   recordings: sent, fetched
viewers      what viewers open
foxglove     what Foxglove's remote data loader asks
pytupli      PyTupli's own routes
"""
