"""From what a killed process or a damaged disk left to episodes.

prefix                                      the records at the start of a file that are whole
unfinished                                  recovery in memory, when an unfinished recording is opened
episodes                                    the starts and ends that are missing, and the index
step_runs                                   which episodes the steps of a channel belong to
evidence, add_journal, segments, plan       what is good in a damaged file and its journal, and the episodes in it
file_end                                    the summary and the index at a file's end, each by itself
"""
