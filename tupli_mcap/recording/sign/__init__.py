"""Signs recordings, and trusts the code in them.

sign              signs a recording
carried_code      describes the code that a recording carries, and trusts it
"""
