"""The catalog of a storage: a database of its episodes, a cache that may be deleted at any time.

catalog             answers queries, and takes in recordings
pages               a page of episodes, found without a look at all others
queries             what is asked of the tables, in any SQL database
database, tables    the database, and what is in it
place               where it lies, for this user alone
entries             what it holds of a recording, read here or by other processes
rows                episodes as rows
filter_sql          turns filters into SQL that finds all candidates; Python checks them again
metadata_sql        looks into metadata with SQL
order               the order of episodes, and the condition for the next page
tallies             sums over the episodes of each recording
"""
