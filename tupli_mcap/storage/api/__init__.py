"""A storage on a server.

client, people     `TupliAPIClient`: the contract of a storage; the users, groups and roles of the server
session, tokens    requests, signed in; where tokens are kept
outbox, waiting    recordings that are written here first and sent behind; what state they are in
upload             sending one of them
"""

from tupli_mcap.storage.api.client import TupliAPIClient

__all__ = ["TupliAPIClient"]
