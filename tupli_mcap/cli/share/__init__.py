"""Commands that share benchmarks and recordings.

bundle     bundle, import, export: files
exchange   push, pull, publish, unpublish: between a directory and a server
people     login, logout, whoami, signup, password; users, groups, roles, tokens for machines
serve      browse: on this machine; serve, backup-server, restore-server: the server
trust      trust, untrust: whose code may run
"""
