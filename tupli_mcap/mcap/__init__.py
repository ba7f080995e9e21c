"""The bytes of MCAP files. Nothing here knows of reinforcement learning.

source                      reads bytes of a path, an open file, a URL
lock                        tells whether the process that writes a file is alive
container                   writes header, metadata, attachments, chunks, summary
records                     parses and checks records; their checksums
walk                        goes over the records of a file, beyond damage too
chunk_records               the messages of a chunk, as arrays
summary                     reads the footer and the summary
compression                 decompresses within bounds
"""
