"""From rows to columns.

chunk_store    decompresses chunks, and keeps some
runs           which rows of which chunks go where
gather         columns out of chunks, of one file or of many: what everybody reads by
read           columns of one recording; where its steps lie, for readers of many
fields         names of columns
statistics     mean, range and quantiles of a leaf, without keeping its values
threads        a small pool
"""
