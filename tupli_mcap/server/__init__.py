"""The server: what a storage holds, shared between people over HTTP.

settings, run         how it is set up; the processes
app, routes/          the routes, and what they answer
pages/                what browsers are shown besides
traffic/              requests and connections: limited, counted, logged
wire                  JSON of requests, answers and errors
library, backup       all that is kept, and changes that touch database and files at once; copies of it
people/               users, groups, roles, tokens, and what each may do and read
stored/               benchmarks, artifacts, recordings and their episodes
uploads, blobs        bytes on their way in, and where they lie
database, tables      the database, and what is in it
migrations/           tables of earlier versions
"""
