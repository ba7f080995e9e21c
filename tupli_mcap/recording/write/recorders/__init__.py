"""What follows an environment, and knows which episode runs.

single, vector   record the episodes of one environment, and of many
autoreset        when the sub-environments of a vector environment begin anew
infos, frames    which infos and pictures of steps are recorded, beside these
"""
