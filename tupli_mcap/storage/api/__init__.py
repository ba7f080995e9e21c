"""A storage on a server.

client, people, recordings    `TupliAPIClient`: the methods of a storage, for people, and for recordings
session, answers, tokens      signed-in requests; their answers and errors; the user's tokens
outbox                        recordings that are written on this machine first, and sent in the background
upload                        sending one recording
"""

from tupli_mcap.storage.api.client import TupliAPIClient
from tupli_mcap.storage.api.tokens import last_server

__all__ = ["TupliAPIClient", "last_server"]
