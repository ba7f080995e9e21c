"""Record reinforcement-learning episodes as MCAP files, index them into datasets, train on them, share them.

wrappers, vector, sb3      record an environment, or many
recording                  one file: read, written, recovered, edited, verified, signed
journal, mcap, messages    keeps the steps of a killed process; the container; the messages in it
spaces, environment        leaves of Gymnasium's spaces; environments as data, and rebuilt
schema                     the models and filters of PyTupli
storage, benchmark         recordings in a directory or on a server; environments that are stored and loaded again
dataset, torch             `open`: episodes of files, directories and servers; DataLoaders
server, page, remote       shares a storage over HTTP; its pages, and `browse`; reads files at URLs
viewer, plots              shows episodes in Rerun and Foxglove, live too; draws figures
doctor, reexecute          finds defects of the data; steps an environment with recorded actions
trust, signing             which code and keys this user trusts; signatures
cli                        the commands
errors, progress, files, cache, jsonvalue, arrays, lazy    what all of them use
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tupli_mcap.benchmark import TupliEnvWrapper as TupliEnvWrapper
    from tupli_mcap.dataset import (
        Dataset as Dataset,
        TupliDataset as TupliDataset,
        merge_recordings as merge_recordings,
        open as open,
        recover_recording as recover_recording,
        restore_episodes as restore_episodes,
        split_recording as split_recording,
    )
    from tupli_mcap.errors import (
        FilterError as FilterError,
        FormatError as FormatError,
        MissingExtraError as MissingExtraError,
        NotFoundError as NotFoundError,
        RecordingError as RecordingError,
        SignatureError as SignatureError,
        SpaceError as SpaceError,
        StepError as StepError,
        StorageError as StorageError,
        TupliError as TupliError,
        UntrustedError as UntrustedError,
    )
    from tupli_mcap.recording import (
        Episode as Episode,
        EpisodeData as EpisodeData,
        Recording as Recording,
        RecoveryReport as RecoveryReport,
        Step as Step,
        VerifyReport as VerifyReport,
        journal_path as journal_path,
        rewrite_recording as rewrite_recording,
        verify_recording as verify_recording,
        write_recording as write_recording,
    )
    from tupli_mcap.schema import (
        EpisodeMetadataCallback as EpisodeMetadataCallback,
        F as F,
        FilterAND as FilterAND,
        FilterCONTAINS as FilterCONTAINS,
        FilterEQ as FilterEQ,
        FilterGEQ as FilterGEQ,
        FilterGT as FilterGT,
        FilterIN as FilterIN,
        FilterLEQ as FilterLEQ,
        FilterLT as FilterLT,
        FilterNE as FilterNE,
        FilterOR as FilterOR,
        RLTuple as RLTuple,
    )
    from tupli_mcap.storage import (
        FileStorage as FileStorage,
        TupliAPIClient as TupliAPIClient,
        TupliStorage as TupliStorage,
    )
    from tupli_mcap.wrappers import (
        EpisodeWriter as EpisodeWriter,
        RecordEpisodes as RecordEpisodes,
        write_rollout as write_rollout,
    )

# The module of each public name, imported on first use, so that `import tupli_mcap` is quick.
_HOMES = {
    "benchmark": "TupliEnvWrapper",
    "dataset": "Dataset TupliDataset merge_recordings open recover_recording restore_episodes split_recording",
    "errors": (
        "FilterError FormatError MissingExtraError NotFoundError RecordingError SignatureError "
        "SpaceError StepError StorageError TupliError UntrustedError"
    ),
    "recording": (
        "Episode EpisodeData Recording RecoveryReport Step VerifyReport journal_path rewrite_recording "
        "verify_recording write_recording"
    ),
    "schema": (
        "EpisodeMetadataCallback F FilterAND FilterCONTAINS FilterEQ FilterGEQ FilterGT FilterIN FilterLEQ FilterLT "
        "FilterNE FilterOR RLTuple"
    ),
    "storage": "FileStorage TupliAPIClient TupliStorage",
    "wrappers": "EpisodeWriter RecordEpisodes write_rollout",
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names.split()}
_MODULES = (
    "benchmark", "dataset", "doctor", "errors", "plots", "recording", "reexecute", "sb3", "schema", "storage", "torch",
    "trust", "vector", "viewer",
)  # fmt: skip

_MEANT = {
    "load load_dataset open_dataset read": "open",
    "Recorder RecordVideo record wrap": "RecordEpisodes",
    "Reader": "Recording",
    "Writer write_episodes": "EpisodeWriter",
    "Client connect login push pull": "TupliAPIClient",
}
"""Names that other packages have for ours."""

__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("tupli-mcap")
    elif name in _HOME_OF:
        value = getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    else:
        from tupli_mcap.errors import by_words, did_you_mean

        meant = did_you_mean(by_words(_MEANT).get(name, name), [*_HOME_OF, *_MODULES])
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{meant}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, *_MODULES, "__version__"]
