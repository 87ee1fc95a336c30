"""Move a clip from a run's source rig to its target: the same as `reenact infer`."""

import sys

from reenact.cli import main

if __name__ == "__main__":
    sys.exit(main(["infer", *sys.argv[1:]]))
