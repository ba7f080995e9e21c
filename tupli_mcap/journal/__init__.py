"""The journal: it keeps each step safe until the step is in the file. `messages.encode_rows` and
`recording.write.rows` write rows into it.

file        the mapped file, its areas, and the recording it belongs to
logs        appends records of variable size, groups them by channel, and seals records with checksums
committed   what a reader takes out of a journal: committed rows, completed with steps and times; running states
derive      what a recorder derives from rows at a flush: starts, ends, final states

1. A recording is rows: each channel is append-only, its rows are numbered 0, 1, 2, … by `sequence`, across appends.
2. A row is in one of three places: the slot that is being written, committed in the journal, or in a chunk of the file.
3. The last store into a row, of `sequence` and `log_time`, commits it. Before that it does not exist.
   `messages.encode_rows` generates the functions that make this store; `recording.write.rows` makes it of many rows.
4. The next state is written into the next slot before that store: the environment may use its buffers again, and the
   running state survives.
5. An area of rows has two halves. A half is written over only when all its rows are in the file.
6. The reader's rule: the rows of a channel are the k rows in chunks, then journal rows k, k + 1, … up to the first that
   is missing. Everything else in the journal is stale. A reader reads the journal first, then the file, because a
   writer moves rows from the journal to the file. Repair alone fills gaps in the file with journal rows.
7. Episodes are derived from rows: each row has its episode's number and flags; the hole after an episode's last row
   holds the final state and the time of the next reset. Start and end records add what rows do not hold: seed,
   options, info, metadata.
8. Index and summary are derived: a writer that appends cuts them off, and writes them again when it closes.
9. Images are one row ahead of steps. Starts, ends, infos, frames, and steps of variable size are in logs; storing the
   offset where a log ends commits its records.

    half:  | row 0 | row 1 | ... | row j: committed | row j+1: state only (running) | ... | spare |
                                   ^ sequence, log_time last   ^ final state, and a hole, if the episode ends here
    file:  | chunk: rows 0 to k-1 of /step | ...               journal: rows k, k+1, ... of /step

`schemas/README.md`, sections 10 and 11, has the bytes and every case.
"""
