"""From rows to columns.

chunk_store    decompresses chunks, and keeps some
runs           rows a to b of a chunk, for rows in any order
read           whole columns
stored_steps   a handle to a recording's step chunks that can be pickled
threads        a small pool
"""
