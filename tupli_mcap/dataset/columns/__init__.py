"""Whole columns of a dataset's episodes.

load         reads them, from episodes to arrays; filters of tuples
tuples       columns as steps and episodes
convert      columns as what other libraries expect
tables       as pandas and Arrow tables
statistics   what the values are like
saved        as a directory of `.npy` files
"""
