"""Recording: from `reset` and `step` to the journal and the file.

recorders/              what follows an environment, and knows which episode runs
rows/                   the rows that are not in the file, a store for each channel
episodes                puts starts, ends and final states into the journal
writer                  the file, its journal, its channels and its episodes
place                   where these lie, and what other writers have left there
chunks                  rows become chunks of the file, in a thread where that is worth it
resume                  goes on in a recording that exists
rotation                what the files are called, and when the next one begins
work                    the mark of unfinished work, for interruptions
options, from_values    options; recordings of given values
"""
