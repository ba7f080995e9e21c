"""Record reinforcement-learning episodes as MCAP files, index them into datasets, train on them, hand them on."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tupli_mcap.benchmark import TupliEnvWrapper
    from tupli_mcap.dataset import TupliDataset, filter_recording
    from tupli_mcap.errors import (
        FilterError,
        FormatError,
        MissingExtraError,
        NotFoundError,
        RecordingError,
        SignatureError,
        SpaceError,
        StepError,
        StorageError,
        TupliError,
        UntrustedError,
    )
    from tupli_mcap.recording import (
        EpisodeData,
        Recording,
        RecoveryReport,
        Step,
        VerifyReport,
        journal_path,
        merge_recordings,
        recover_recording,
        rewrite_recording,
        split_recording,
        verify_recording,
        write_recording,
    )
    from tupli_mcap.schema import (
        EpisodeMetadataCallback,
        F,
        FilterAND,
        FilterEQ,
        FilterGEQ,
        FilterGT,
        FilterIN,
        FilterLEQ,
        FilterLT,
        FilterNE,
        FilterOR,
        RLTuple,
    )
    from tupli_mcap.storage import FileStorage, TupliStorage
    from tupli_mcap.wrappers import RecordEpisodes

# Where each public name lives; imported on first use, so that `import tupli_mcap` stays quick.
_HOMES = {
    "benchmark": ["TupliEnvWrapper"],
    "dataset": ["TupliDataset", "filter_recording"],
    "errors": [
        "FilterError",
        "FormatError",
        "MissingExtraError",
        "NotFoundError",
        "RecordingError",
        "SignatureError",
        "SpaceError",
        "StepError",
        "StorageError",
        "TupliError",
        "UntrustedError",
    ],
    "recording": [
        "EpisodeData",
        "Recording",
        "RecoveryReport",
        "Step",
        "journal_path",
        "merge_recordings",
        "recover_recording",
        "split_recording",
        "VerifyReport",
        "rewrite_recording",
        "verify_recording",
        "write_recording",
    ],
    "schema": [
        "EpisodeMetadataCallback",
        "F",
        "FilterAND",
        "FilterEQ",
        "FilterGEQ",
        "FilterGT",
        "FilterIN",
        "FilterLEQ",
        "FilterLT",
        "FilterNE",
        "FilterOR",
        "RLTuple",
    ],
    "storage": ["FileStorage", "TupliStorage"],
    "wrappers": ["RecordEpisodes"],
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "EpisodeData",
    "EpisodeMetadataCallback",
    "F",
    "FileStorage",
    "FilterAND",
    "FilterEQ",
    "FilterError",
    "FilterGEQ",
    "FilterGT",
    "FilterIN",
    "FilterLEQ",
    "FilterLT",
    "FilterNE",
    "FilterOR",
    "FormatError",
    "MissingExtraError",
    "NotFoundError",
    "RLTuple",
    "RecordEpisodes",
    "Recording",
    "RecordingError",
    "RecoveryReport",
    "SignatureError",
    "SpaceError",
    "Step",
    "StepError",
    "StorageError",
    "TupliDataset",
    "TupliEnvWrapper",
    "TupliError",
    "TupliStorage",
    "UntrustedError",
    "VerifyReport",
    "filter_recording",
    "journal_path",
    "merge_recordings",
    "recover_recording",
    "rewrite_recording",
    "split_recording",
    "verify_recording",
    "write_recording",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
