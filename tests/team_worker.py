"""One process of a team, for tests/test_team.py: trains, keeps gradients, and may kill itself.

torchrun --nproc-per-node N tests/team_worker.py CONFIG.toml GRADIENTS.safetensors [--resume] [--kill RANK STEP]
"""

import argparse
import os
import signal
import sys
from pathlib import Path

import safetensors.torch

from reenact import training
from reenact.config import load_config
from reenact.errors import ReenactError


def keep_gradients(path: Path) -> dict:
    """Let the training keep the gradients that it first steps with, and write them from the first process."""
    kept = {}
    check = training._not_finite

    def look(losses, trained):
        if not kept:
            kept.update({f"{index}": each.grad.clone() for index, each in enumerate(trained) if each.grad is not None})
            if int(os.environ.get("RANK", "0")) == 0:
                safetensors.torch.save_file(kept, path)
        return check(losses, trained)

    training._not_finite = look
    return kept


def kill(rank: int, step: int) -> None:
    """Let one process die by SIGKILL when it comes to a step."""
    rate = training.learning_rate

    def die(now, *others):
        if now == step and int(os.environ["RANK"]) == rank:
            os.kill(os.getpid(), signal.SIGKILL)
        return rate(now, *others)

    training.learning_rate = die


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("config", type=Path)
    parser.add_argument("gradients", type=Path)
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--kill", type=int, nargs=2)
    arguments = parser.parse_args()
    keep_gradients(arguments.gradients)
    if arguments.kill:
        kill(*arguments.kill)
    try:
        training.train(load_config(arguments.config), resume=arguments.resume)
    except ReenactError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
