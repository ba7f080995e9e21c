"""The command line: `tupli-mcap`. Every command parses, calls one library function, and prints."""

from tupli_mcap.cli.app import app, main

__all__ = ["app", "main"]
