"""What loading a pickle would import, call and define, found without loading it.

The opcodes are followed on a stack of symbols, as the unpickler would follow them on objects: names that come from
the memo are resolved as it resolves them. What cannot be followed is said (`PickleScan.problems`), never left out.
"""

from __future__ import annotations

from typing import NamedTuple

from tupli_mcap.environment._machine import follow
from tupli_mcap.environment._verdicts import Verdict, verdict_of

__all__ = ["PickleImport", "PickleScan", "scan_pickle"]


class PickleImport(NamedTuple):
    """Something that loading would import, `module` and (dotted) `name`; `name` is empty for a module itself.

    verdict: "dangerous" runs commands, opens files or reaches everything else; "known" is part of ordinary pickled
    environments; "unknown" is neither, as the classes of other packages are.
    """

    module: str
    name: str
    verdict: Verdict

    def __str__(self) -> str:
        return f"{self.module}:{self.name}" if self.name else self.module


class PickleScan(NamedTuple):
    """What loading a pickle would do, as far as can be told without doing it.

    imports: each once, in the order of their first use.
    calls: what is called on loading, with its arguments; calls that only rebuild known objects are left out.
    functions, classes: qualified names of those whose code is in the pickle itself.
    uses: the telling names (`os`, `system`, `eval`, ...) that those functions mention.
    problems: what could not be followed: the pickle may do more than is listed.
    """

    imports: tuple[PickleImport, ...]
    calls: tuple[str, ...]
    functions: tuple[str, ...]
    classes: tuple[str, ...]
    uses: tuple[str, ...]
    problems: tuple[str, ...]

    @property
    def suspicious(self) -> bool:
        """Whether something is dangerous or could not be followed. False does not mean harmless."""
        return bool(self.problems) or bool(self.uses) or any(i.verdict == "dangerous" for i in self.imports)


def scan_pickle(data: bytes) -> PickleScan:
    """Reads the opcodes of a pickle; nothing is imported or run, and no pickle makes it fail.

    Time and memory are linear in the size of the pickle, of which the first 500,000 opcodes are followed.
    """
    found = follow(data)
    names = [PickleImport(module, name, verdict_of(module, name)) for module, name in found.imports]
    return PickleScan(
        tuple(names),
        tuple(found.calls),
        tuple(found.functions),
        tuple(found.classes),
        tuple(sorted(found.uses)),
        tuple(found.problems),
    )
