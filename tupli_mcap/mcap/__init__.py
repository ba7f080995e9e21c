"""The bytes of MCAP files; knows nothing of reinforcement learning.

source                      where bytes come from: a path, an open file, a URL
lock                        whether the process that writes a file is alive
container                   writes: header, metadata, attachments, chunks, summary
records                     the records, how they lie in bytes: parsed, and checked; their checksums
walk                        over the records of a file, behind damage too
chunk_records               the messages of a chunk, as arrays
summary                     reads the footer and the summary
compression                 bytes made small
"""
