"""Facts about a recording besides its steps.

run          its run: name, settings, facts about the process
annotations  statements about episodes, made after they were recorded
success      whether an episode succeeded, from infos and metadata
described    an open recording with all of these
"""
