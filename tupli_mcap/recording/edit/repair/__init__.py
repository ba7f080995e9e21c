"""A new recording out of a damaged one.

recover   `recover_recording`: finds what is left, decides what to keep, and reports
write     writes it, renumbered
frames    the frames of what is kept
"""
