"""Makes a new recording of a damaged one.

recover   `recover_recording`, `finish_recording`: find what is left, decide what to keep, and report
write     writes it, renumbered, with the frames of steps that are kept
"""
