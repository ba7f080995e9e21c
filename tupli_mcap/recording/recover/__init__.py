"""Decides which episodes a killed process or a damaged disk has left. Opening a recording uses this, and so does
`recording.edit.repair`, which writes a new file.

prefix, damaged       what is good in a file: up to its first damage, or wherever it lies
find_journal          the journal of an unfinished recording
add_journal           what the journal adds
evidence              all of that together: rows by channel and number
step_runs             consecutive steps of an episode
episodes              makes the episodes of that: start, end, final state of each; which steps are missing
unfinished            opens an unfinished recording: calls the modules above, and makes its index in memory
file_end              the summary and the index at a file's end, each by itself
"""
