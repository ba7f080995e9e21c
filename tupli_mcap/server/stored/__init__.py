"""The stored items of a server. What takes a connection works in the transaction of its caller.

items                benchmarks and artifacts
episodes, arrivals   recordings and their episodes: stored ones, and new ones
selection            the episodes of a query, as one recording
sharing              what is a user's of a dataset, published as a whole
"""
