"""A storage on a server.

client, people, recordings    `TupliAPIClient`: the contract of a storage, the server's people, its files
session, answers, tokens      requests, signed in; what is answered; where tokens are kept
outbox, waiting               recordings that are written here first and sent behind; what state they are in
upload                        sending one of them
"""

from tupli_mcap.storage.api.client import TupliAPIClient

__all__ = ["TupliAPIClient"]
