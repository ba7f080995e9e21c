"""Finds the episodes that a killed process or a damaged disk has left. Opening a recording uses this, and so
does `recording.edit.repair`, which writes a new file.

evidence        everything that was found: rows by channel and number; reads a file up to its first damage
from_journal    finds the journal of an unfinished recording, and adds its rows
damaged         collects what is good anywhere in a file, and the summary and index at its end
step_runs       finds consecutive steps of an episode
episodes        derives the episodes from it: start, end, final state of each; steps that are missing
unfinished      recovers an unfinished recording in memory when it is opened
"""
