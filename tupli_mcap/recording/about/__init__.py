"""What is said of a recording beside its steps.

run          the run that it is of: name, settings, what the process was
annotations  what somebody said about episodes afterwards
success      whether an episode succeeded, as infos and metadata say it
described    an open recording with all of these
"""
