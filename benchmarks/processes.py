"""One process against several on one training, by turns: seconds from the first rendering to the end.

Every process has one thread. What comes before (rigs, components, layouts) is the first process's alone and is not
counted. Medians of several turns; on a machine that others use, the slower process of each step decides. `--json FILE`
writes seconds["1"], ["2"]: one number a turn.

    python benchmarks/processes.py [--processes 1 2] [--turns 3] [--steps 80] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
SETTINGS = ("--layout.method", "none", "--reenactnet.components", "128", "--training.batch-size", "64")
SETTINGS += ("--training.frames", "1024", "--training.refresh", "0", "--training.threads", "1")


def seconds(processes: int, steps: int) -> float:
    """Wall time of one training of man and toon in a folder that is thrown away.

    Raises:
        RuntimeError: It did not end as it should.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", str(processes), "--"]
        command += [str(ROOT / "train.py"), "--run", f"{folder}/run", "--training.steps", str(steps), *SETTINGS]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
        began = ended = None
        said = []
        with subprocess.Popen(
            command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        ) as training:
            for line in training.stdout:
                said.append(line)
                if began is None and "fresh expressions" in line:
                    began = time.perf_counter()
                if line.startswith("Trained:"):
                    ended = time.perf_counter()
        if training.returncode != 0 or began is None or ended is None:
            raise RuntimeError("".join(said[-20:]))
    return ended - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--steps", type=int, default=80)
    parser.add_argument("--json", type=Path, help="write the numbers there")
    arguments = parser.parse_args()
    found: dict[int, list[float]] = {count: [] for count in arguments.processes}
    for _ in range(arguments.turns):
        for count, values in found.items():
            values.append(seconds(count, arguments.steps))
    print("| processes | seconds, by turns | median |\n|---|---|---|")
    for count, values in found.items():
        print(f"| {count} | {', '.join(f'{value:.1f}' for value in values)} | {statistics.median(values):.1f} |")
    if arguments.json:
        arguments.json.write_text(json.dumps({"seconds": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
