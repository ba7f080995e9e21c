"""Revisions of the tables of a server, in the order of their numbers. One that was released is never changed."""
