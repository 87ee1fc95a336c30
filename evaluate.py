"""Measure trained runs on clips that they have not seen: the same as `reenact evaluate`."""

import sys

from reenact.cli import main

if __name__ == "__main__":
    sys.exit(main(["evaluate", *sys.argv[1:]]))
