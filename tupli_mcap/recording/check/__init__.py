"""Verifies recordings.

verify        `verify_recording` checks everything below
structure     the records of the file, and their checksums
episodes      index, starts, ends, final states, images and infos against the steps
frames        frames against the steps
signature     a signature against everything that it covers
report        the problems found, for people and as JSON
"""
