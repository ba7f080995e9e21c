"""Recording: from `reset` and `step` to the journal and the file.

single, vector                               record the episodes of one environment, and of many
rows/                                        the rows that are not in the file, a store for each channel
episodes, infos, frames                      put what else is recorded into the journal
writer, journals                             the file and its journal; journals that others have left
resume                                       goes on in a recording that exists
rotation                                     what the files are called, and when the next one begins
work                                         the mark of unfinished work, for interruptions
autoreset                                    when the sub-environments of a vector environment begin anew
compressing, options, from_values            chunks in a thread; options; recordings of given values
"""
