"""Whole columns of a dataset's episodes.

load         reads columns of episodes; applies tuple filters
labels       labels in tuple filters
tuples       columns as steps and episodes
convert      columns in the forms of other libraries
tables       pandas and Arrow tables
statistics   statistics of values
saved        columns as a directory of `.npy` files
"""
