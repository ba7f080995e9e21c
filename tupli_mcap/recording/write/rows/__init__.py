"""Rows that are not in the file yet, a class for each kind of channel. Each class commits rows to a half of the
journal; when the half is full, it goes on in the other one and hands the full one over as a chunk.

contract          the interface, and the rules that every class keeps
single, vector    steps of constant size, of one environment (put by `messages.encode_rows`) and of many
variable          steps of variable size
images            the images of a leaf
stores            one of these for each channel of a recording
"""
