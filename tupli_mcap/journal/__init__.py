"""The journal: what keeps each step safe before it is in the file. `messages.encode_rows` and `recording.write.rows`
write rows into it.

file        the mapped file, its areas, and who it belongs to
logs        records of variable size: append, and group by channel
committed   what a reader takes out of a journal: `rows_of`, the running states
derive      what the recorder makes from rows when these go to the file: steps and times; starts, ends, final states
seals       which rows count after a power loss

1. A recording is rows: each channel is append-only, its rows are numbered 0, 1, 2, … by `sequence`, across appends.
2. A row is in one of three places: the slot that is being written, committed in the journal, or in a chunk of the file.
3. A row is committed by its last store, of `sequence` and `log_time`. Before that it does not exist.
4. The next state is written into the next slot before that store: the environment may use its buffers again, and the
   running state survives.
5. The journal has two halves. A half is written over only when all its rows are in the file.
6. The reader's rule: the rows of a channel are the k rows in chunks, then journal rows k, k + 1, … up to the first that
   is missing. Everything else in the journal is stale. A reader takes the journal first, then the file: a writer only
   moves rows that way. Only repair, where the file lost rows, takes journal rows wherever they are missing.
7. Episodes follow from rows: number and flags are in each row; the hole after an episode's last row holds the final
   state and the time of the next reset. Start and end records add what rows cannot say: seed, options, info, metadata.
8. The index and the summary are derived: appending cuts them off, closing writes them again.
9. Images run one row ahead of steps. Starts, ends, infos and frames, and steps of variable size, are logs, committed by
   the offset where they end.

    half:  | row 0 | row 1 | ... | row j: committed | row j+1: state only (running) | ... | spare |
                                   ^ sequence, log_time last   ^ final state, and a hole, if the episode ends here
    file:  | chunk: rows 0 to k-1 of /step | ...               journal: rows k, k+1, ... of /step

`schemas/README.md`, sections 10 and 11, has the bytes and every case.
"""
