"""New recordings out of others.

assemble                          the new file: writes chunks, or copies them as they are, index and summary
copy_episodes                     episodes of a recording into it, under new numbers
merge, split                      several recordings into one, numbered on; one into several
stream                            a recording of some episodes, handed on while it is made
rewrite                           a recording with fewer episodes
relabel, trim                     a recording with other values of steps; with fewer steps of episodes
made_of                           what a recording was made of
attach, annotate                  adds attachments; says more about episodes and the run
carry_runs                        what recordings say of runs and episodes, for one made of them
repair                            a recording out of a damaged one
replacing                         the new file takes the place of the old one
"""
