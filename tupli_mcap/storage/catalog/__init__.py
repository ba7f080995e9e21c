"""The catalog of a storage: a database of its episodes, a cache that may be deleted at any time.

catalog             keeps it up to date with the directory, and answers queries
database, tables    the database, and what is in it
entries, rows       recordings and episodes, as rows
sql, sqlite         filters as SQL
"""
