"""Who vouches for a recording.

sign              signs a recording, and checks a signature
signature_file    the attachment that a signature is
carried_code      the code that a recording carries, and trusting it
"""
