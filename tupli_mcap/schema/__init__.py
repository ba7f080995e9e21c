"""Models of benchmarks, artifacts, episodes and people, and filters over them. No I/O.

models, people, success      benchmarks, artifacts, episodes; users, groups, roles; whether an episode succeeded
filters, field, parse        filters; built with `F`, read from text
keys, values, times          keys, values and times in filters, and their comparison
facts                        checks filters against a model
predicate                    filters evaluated in memory"""

from tupli_mcap.schema.facts import bound, check_keys, filter_keys, parse_bound
from tupli_mcap.schema.field import F
from tupli_mcap.schema.filters import (
    BaseFilter,
    EpisodesListRequest,
    FilterAND,
    FilterCONTAINS,
    FilterEQ,
    FilterGEQ,
    FilterGT,
    FilterIN,
    FilterLEQ,
    FilterLT,
    FilterNE,
    FilterNOT,
    FilterOR,
    FilterType,
)
from tupli_mcap.schema.keys import join_key, split_key
from tupli_mcap.schema.models import (
    ArtifactMetadata,
    ArtifactMetadataItem,
    Benchmark,
    BenchmarkHeader,
    BenchmarkMetadata,
    BenchmarkQuery,
    DBItem,
    Episode,
    EpisodeHeader,
    EpisodeItem,
    EpisodeMetadataCallback,
    RLTuple,
)
from tupli_mcap.schema.parse import format_filter, format_key, parse_filter
from tupli_mcap.schema.people import (
    RIGHT,
    ApiToken,
    Group,
    GroupMembership,
    GroupMembershipQuery,
    GroupWithMembers,
    ListedUser,
    Me,
    Membership,
    Right,
    UserOut,
    UserRole,
)
from tupli_mcap.schema.predicate import compile_predicate, evaluate_columns

__all__ = [
    "RIGHT",
    "ApiToken",
    "ArtifactMetadata",
    "ArtifactMetadataItem",
    "BaseFilter",
    "Benchmark",
    "BenchmarkHeader",
    "BenchmarkMetadata",
    "BenchmarkQuery",
    "DBItem",
    "Episode",
    "EpisodeHeader",
    "EpisodeItem",
    "EpisodeMetadataCallback",
    "EpisodesListRequest",
    "F",
    "FilterAND",
    "FilterCONTAINS",
    "FilterEQ",
    "FilterGEQ",
    "FilterGT",
    "FilterIN",
    "FilterLEQ",
    "FilterLT",
    "FilterNE",
    "FilterNOT",
    "FilterOR",
    "FilterType",
    "Group",
    "GroupMembership",
    "GroupMembershipQuery",
    "GroupWithMembers",
    "ListedUser",
    "Me",
    "Membership",
    "RLTuple",
    "Right",
    "UserOut",
    "UserRole",
    "bound",
    "check_keys",
    "compile_predicate",
    "evaluate_columns",
    "filter_keys",
    "format_filter",
    "format_key",
    "join_key",
    "parse_bound",
    "parse_filter",
    "split_key",
]
