"""The server: shares benchmarks, artifacts and recordings between users over HTTP.

settings, run         settings; starting the processes
app, routes/          the application and its routes
pages/                further pages for browsers
traffic/              requests and connections: limited, counted, logged
wire                  JSON of requests, answers and errors
library, backup       changes that touch database and files at once; backups of both
people/               users, groups, roles, tokens, and what each may do and read
stored/               benchmarks, artifacts, recordings and their episodes
uploads, blobs        unfinished uploads; where finished files are kept
database, tables      the database, and its tables
migrations/           tables of earlier versions
"""
