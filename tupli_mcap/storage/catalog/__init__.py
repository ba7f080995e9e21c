"""The catalog of a storage: a database of its episodes, a cache that may be deleted at any time.

catalog             answers queries, and takes in recordings
pages               finds a page of episodes without checking all others
queries             changes and queries of the tables, in any SQL database
database, tables    the SQLite database, and its tables
place               its path, in a directory of this user alone
entries             reads the entry of a recording
rows                episodes as rows
filter_sql          turns filters into SQL that finds all candidates; Python checks them again
compare_sql         turns one comparison into SQL
metadata_sql        SQL that differs between databases: a look into metadata, one of many ids
order               the order of episodes, and the condition for the next page
tallies             sums over the episodes of each recording
"""
