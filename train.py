"""Train networks that move expressions between two rigs: the same as `reenact train`."""

import sys

from reenact.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
