"""The command line: `tupli-mcap`. Every command parses, calls one library function, and prints.

`app` lists the commands and where each of them is: `record`, `lists` (ls, episodes), `info`, `doctor`, `verify`,
`edit` (tag, edit, merge, split, filter, recover), `replay`, `render` (render, plot), `storage` (list-..., compact,
reindex), `bundle` (bundle, import, export), `trust` (trust, untrust). What they print is formatted by `output` and
written by `terminal`, which lets nothing from a file reach the terminal as a control character.
"""

from tupli_mcap.cli.app import app, main

__all__ = ["app", "main"]
