"""Looking at recorded data as someone who is about to train on it: `examine`, and the findings it returns."""

from tupli_mcap.doctor.checks import CHECKS, Check
from tupli_mcap.doctor.examine import examine
from tupli_mcap.doctor.findings import Diagnosis, Finding, Place, Severity

__all__ = ["CHECKS", "Check", "Diagnosis", "Finding", "Place", "Severity", "examine"]
