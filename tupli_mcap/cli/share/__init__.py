"""Commands that hand things on.

bundle     one file with all that a benchmark needs, and back
exchange   push, pull, publish: between a directory and a server
account    login, logout, whoami
browse     a page of recordings on this machine
serve      the server
trust      whose code may run
"""
