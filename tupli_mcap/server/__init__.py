"""The server: what a storage holds, shared between people over HTTP.

settings              how it is set up
app, routes/          the routes, and what they answer
wire                  JSON of requests, answers and errors
library               all that is kept, and changes that touch database and files at once
people/               users, groups, roles, tokens, and what each may do and read
items, episodes       benchmarks and artifacts; recordings and their episodes
selection             which episodes a query means
uploads, blobs        bytes on their way in, and where they lie
database, tables      the database, and what is in it
run                   the process
"""
