"""Commands that change recordings.

about     tag, edit: what a recording says of its episodes and runs
copy      merge, split, filter, trim, relabel: new recordings
recover   recover: a new recording of what is undamaged
"""
