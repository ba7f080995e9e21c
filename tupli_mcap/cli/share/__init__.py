"""Commands that share benchmarks and recordings.

bundle     bundle, import, export: files
exchange   push, pull, publish, unpublish: between a directory and a server
account    login, logout, whoami, signup, password
people     users, groups, roles, tokens for machines
browse     browse: recordings in a browser
serve      serve: the server
upkeep     backup-server, restore-server
trust      trust, untrust: whose code may run
"""
