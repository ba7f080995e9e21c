"""Checks recorded data before training on it.

`examine` reads recordings and returns a `Diagnosis` of `Finding`s. `CHECKS` lists what is checked:

- values: NaN, infinities, values outside of their space, dimensions that never change, actions that never occur;
- steps: frozen cameras, reward outliers, clock jumps;
- episodes: missing terminals, episodes of one step, wrong resets, repeated seeds, duplicates;
- files that are not finished.

A check and the `Statistic` that it needs to measure over the steps are in the same module.
"""

from tupli_mcap.doctor.checks import CHECKS, Check
from tupli_mcap.doctor.examine import examine
from tupli_mcap.doctor.findings import Diagnosis, Finding, Place, Severity

__all__ = ["CHECKS", "Check", "Diagnosis", "Finding", "Place", "Severity", "examine"]
