"""Looks at recorded data as someone who is about to train on it.

`examine` reads recordings and returns a `Diagnosis` of `Finding`s. `CHECKS` lists what is checked:

- values: NaN, infinities, values outside of their space, dimensions that never change, actions that never occur;
- steps: frozen cameras, reward outliers, clock jumps;
- episodes: missing terminals, episodes of one step, wrong resets, repeated seeds, duplicates;
- files that are not finished.

A check and what it needs to have measured of the steps (a `Statistic`) are in the module of their family.
"""

from tupli_mcap.doctor.checks import CHECKS, Check
from tupli_mcap.doctor.examine import examine
from tupli_mcap.doctor.findings import Diagnosis, Finding, Place, Severity

__all__ = ["CHECKS", "Check", "Diagnosis", "Finding", "Place", "Severity", "examine"]
