"""Checks recorded data before training on it.

examine           `examine` reads recordings and returns a `Diagnosis` of `Finding`s (`findings`)
checks            `CHECKS`: all checks, in order
values            NaN, infinities, values outside of their space, dimensions that never change, actions that never occur
steps             frozen cameras, reward outliers, clock jumps
episodes          unfinished files, missing terminals, episodes of one step, wrong resets, repeated seeds
duplicates        episodes that occur more than once
measurements      statistics of a recording, for the checks; a check and its `Statistic` are in the same module
message_text      numbers, times and dimensions in messages
"""

from tupli_mcap.doctor.checks import CHECKS, Check
from tupli_mcap.doctor.examine import examine
from tupli_mcap.doctor.findings import Diagnosis, Finding, Place, Severity

__all__ = ["CHECKS", "Check", "Diagnosis", "Finding", "Place", "Severity", "examine"]
