"""The catalog of a storage: a database of its episodes, a cache that may be deleted at any time.

catalog             answers queries, and takes in recordings
pages               a page of episodes, found without a look at all others
queries             what is asked of the tables, in any SQL database
database, tables    the database, and what is in it
place               where it lies, for this user alone
entries             what it holds of a recording, read here or by other processes
rows                episodes as rows
filter_sql          filters as SQL that finds what may match; Python looks at that again
metadata_sql        what SQL finds in metadata
order               the order of episodes, and where a page goes on
tallies             numbers of each recording, without its episodes
"""
