"""The command line: `tupli-mcap`. Every command parses, calls one library function, and prints.

app            lists the commands, with the module of each; turns an error into a line and an exit code
ls, episodes, info, record, view   the commands of these names
render         render, plot
edit/          tag, edit, merge, split, filter, trim, relabel, recover
doctor         doctor
verify         verify
storage        delete, restore, compact, rename, reindex, declare-key, list-benchmarks, list-artifacts, list-episodes
share/         bundles, trust, servers
options        options of several commands
output         formats what is printed
terminal       prints it, and lets no control character of a file through
"""

import sys

try:
    from tupli_mcap.cli.app import app, main
except KeyboardInterrupt:  # Ctrl-C before there is a command, which `app` would handle
    sys.stderr.write("interrupted; nothing was changed\n")
    sys.exit(130)

__all__ = ["app", "main"]
