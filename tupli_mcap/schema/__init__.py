"""What benchmarks, artifacts and episodes are described by, and the filters over them. No I/O."""

from tupli_mcap.schema.facts import bound, check_keys, filter_keys
from tupli_mcap.schema.field import F
from tupli_mcap.schema.filters import (
    BaseFilter,
    EpisodesListRequest,
    FilterAND,
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
from tupli_mcap.schema.parse import format_filter, parse_filter
from tupli_mcap.schema.predicate import compile_predicate, evaluate_columns

__all__ = [
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
    "RLTuple",
    "bound",
    "check_keys",
    "compile_predicate",
    "evaluate_columns",
    "filter_keys",
    "format_filter",
    "join_key",
    "parse_filter",
    "split_key",
]
