"""The journal: what keeps each step safe before it is in the file. Both sides of each layout are here.

file        the mapped file, its areas, and who it belongs to
logs        records of variable size: append, and read back
committed   rows and records that the journal still holds
derive      starts, ends and final states of episodes, made from rows
seals       which rows count after a power loss
"""
