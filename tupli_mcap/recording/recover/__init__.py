"""Finds the episodes that a killed process or a damaged disk has left. Opening a recording uses this, and so
does `recording.edit.repair`, which writes a new file.

from_file       collects what is good in a file: up to its first damage, or anywhere
file_end        reads the summary and the index at a file's end
from_journal    finds the journal of an unfinished recording, and adds its rows
evidence        everything that was found: rows by channel and number
step_runs       finds consecutive steps of an episode
episodes        derives the episodes from it: start, end, final state of each; steps that are missing
unfinished      recovers an unfinished recording in memory when it is opened
"""
