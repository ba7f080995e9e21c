"""Makes new recordings of others.

assemble                          writes or copies the chunks of the new file, its index and summary; puts it in place
copy_episodes                     copies episodes of a recording into it, with new numbers
merge, split                      joins several recordings into one, and renumbers the episodes; splits one into several
stream                            yields the bytes of a recording of some episodes while it is made
rewrite                           a recording with fewer episodes; what is carried: runs, annotations, sources
relabel, trim                     a recording with other values of steps; with fewer steps of episodes
attach, annotate                  adds attachments; annotates episodes, and edits the run
repair                            a recording made of a damaged one
"""
