"""Who vouches for a recording.

sign              signs a recording, and checks a signature
carried_code      the code that a recording carries, and trusting it
"""
