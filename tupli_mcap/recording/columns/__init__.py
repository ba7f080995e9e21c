"""Reads rows as columns.

chunk_store    decompresses chunks, and caches some
runs           finds the chunks that hold rows
gather         copies rows of chunks into columns, from one file or many, on a few threads
read           columns of one recording; a handle to its step chunks
fields         the names of columns; columns that are found by name
"""
