"""From rows to columns.

chunk_store    decompresses chunks, and keeps some
runs           which rows of which chunks go where
gather         columns out of chunks, of one file or of many: what everybody reads by
read           columns of one recording
stored_steps   where the steps of a recording lie, apart from the open file
threads        a small pool
"""
