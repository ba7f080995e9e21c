"""A storage on a server.

client      `TupliAPIClient`: the contract of a storage, and the users, groups and roles of the server
session     requests, signed in
sending     recordings that are written here first, and sent behind
"""

from tupli_mcap.storage.api.client import TupliAPIClient

__all__ = ["TupliAPIClient"]
