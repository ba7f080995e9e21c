"""The server: what a storage holds, shared between people over HTTP.

settings              how it is set up
app, routes/          the routes, and what they answer
wire                  JSON of requests, answers and errors
library               all that is kept, and changes that touch database and files at once
accounts, tokens      users, groups, roles; how they prove who they are (throttle: not too often)
access                what a caller may do, and the one condition for what they may read
items, episodes       benchmarks and artifacts; recordings and their episodes
uploads, blobs        bytes on their way in, and where they lie
database, tables      the database, and what is in it
run                   the process
"""
