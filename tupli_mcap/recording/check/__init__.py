"""Whether a recording is what it says it is.

verify        `verify_recording`: does everything below
structure     the records of the file, and their checksums
episodes      the index and the events against the steps
frames        frames and images against the steps
signature     a signature against what it covers
report        what is found, for people and as JSON
"""
