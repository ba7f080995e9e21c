"""`python -m tupli_mcap` is `tupli-mcap`."""

from tupli_mcap.cli import main

if __name__ == "__main__":
    main()
