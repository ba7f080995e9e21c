"""The bytes of MCAP files. Nothing here knows of reinforcement learning.

source                      reads bytes of a path, an open file, a URL
lock                        tells whether the process that writes a file is alive
container                   writes header, metadata, attachments, chunks, summary
records                     parses and checks records, their checksums, the footer and the summary
walk                        goes over the records of a file, beyond damage too
chunks                      decompresses a chunk within bounds; its messages, as arrays
"""
