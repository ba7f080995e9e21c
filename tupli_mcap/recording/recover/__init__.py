"""Decides which episodes a killed process or a damaged disk has left, for readers and for repair.

prefix, damaged       what is good in a file: up to its first damage, or wherever it lies
find_journal          the journal of an unfinished recording
add_journal           what the journal adds
evidence              all of that together: rows by channel and number
step_runs             consecutive steps of an episode
episodes              which episodes there are: start, end, final state of each; which steps are missing
unfinished            recovery in memory, when an unfinished recording is opened
file_end              the summary and the index at a file's end, each by itself
"""
