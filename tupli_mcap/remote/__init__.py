"""Files on web servers and in buckets, read in place.

objects:  one object behind a URL: its size, its version, and ranges of its bytes (obstore, or fsspec).
failures: errors of failed requests.
plan:     which ranges are fetched in one request, and when a server should cut out episodes instead.
source:   the file as a reader sees it: ranges are fetched ahead and cached; a changed object is an error.
kept:     blocks that stay on disk for other processes, where the user wants it.
patterns: the URLs that match a pattern such as "s3://bucket/runs/*.mcap".
names:    tells paths and URLs apart, and removes secrets from them.
"""

from tupli_mcap.remote.failures import AUTHORITY, why
from tupli_mcap.remote.names import (
    check_local,
    in_home,
    is_server,
    is_url,
    is_web,
    path_of,
    shown,
    shown_argument,
    shown_name,
)
from tupli_mcap.remote.objects import open_store
from tupli_mcap.remote.patterns import is_pattern, matching
from tupli_mcap.remote.plan import is_cut_cheaper
from tupli_mcap.remote.source import RemoteSource, copied, open_url, watching

__all__ = [
    "AUTHORITY",
    "RemoteSource",
    "check_local",
    "copied",
    "in_home",
    "is_cut_cheaper",
    "is_pattern",
    "is_server",
    "is_url",
    "is_web",
    "matching",
    "open_store",
    "open_url",
    "path_of",
    "shown",
    "shown_argument",
    "shown_name",
    "watching",
    "why",
]
