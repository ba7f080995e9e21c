"""Commands that hand things on.

bundle     one file with all that a benchmark needs, and back
exchange   push, pull, publish: between a directory and a server
account    login, logout, whoami, signup, password
people     users, groups, roles, tokens for machines
browse     a page of recordings on this machine
serve      the server
upkeep     backup-server, restore-server
trust      whose code may run
"""
