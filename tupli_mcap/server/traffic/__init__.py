"""What comes to a server: requests and connections, which are limited, counted and logged.

gate        what every request goes through
patience    connections whose clients keep the server waiting
metrics     what is counted, for Prometheus
logs        the log
"""
