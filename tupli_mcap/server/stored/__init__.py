"""What a server stores, in transactions of whoever calls.

items                benchmarks and artifacts
episodes, arrivals   recordings and their episodes: those that are there, and those that come
selection            the episodes that a query means, as one recording
"""
