"""Describes recordings for people: what `info`, reports and pages show.

description   facts that need no step: counts, sizes, spaces, channels
series        short series of its returns, lengths, states and actions
"""
