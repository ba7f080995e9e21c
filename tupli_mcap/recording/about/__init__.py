"""Facts about a recording besides its steps.

run          its run: name, settings, facts about the process
annotations  statements about episodes, made after they were recorded
success      keeps the success that the last info says (`schema.success` decides it) in the metadata; says it in words
described    an open recording with all of these
"""
