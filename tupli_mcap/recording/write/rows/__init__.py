"""Rows that are not in the file yet, a class for each kind of channel: they commit rows to a half of the journal, and
when it is full, go on in the other one and hand over a chunk.

contract          what all of them keep to
single, vector    steps of constant size, of one environment (put by `messages.encode_rows`) and of many
variable          steps of variable size
images            the images of a leaf
stores            one of these for each channel of a recording
"""
