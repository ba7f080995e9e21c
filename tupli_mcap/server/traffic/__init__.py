"""Limits, counts and logs the requests and connections of a server.

gate        wraps every request
patience    ends connections whose clients keep the server waiting
metrics     counters for Prometheus
logs        the log
"""
