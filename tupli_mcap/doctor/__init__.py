"""Checks recorded data before training on it.

examine           `examine` runs the checks on recordings; `CHECKS`: all checks, in order
findings          a `Diagnosis` of `Finding`s, and the words of their messages
values            NaN, infinities, values outside of their space, dimensions that never change, actions that never occur
steps             frozen cameras, reward outliers, clock jumps
episodes          unfinished files, missing terminals, episodes of one step, wrong resets, repeated seeds, duplicates
measurements      statistics of a recording, for the checks; a check and its `Statistic` are in the same module
"""

from tupli_mcap.doctor.examine import CHECKS, Check, examine
from tupli_mcap.doctor.findings import Diagnosis, Finding, Place, Severity

__all__ = ["CHECKS", "Check", "Diagnosis", "Finding", "Place", "Severity", "examine"]
