"""Team: the processes that train one run together, started by torchrun, or a single one.

Each takes its share of the work, and all know the sum. What is shared does not depend on how many there are, but for
the order in which floats are added. The first process leads: it alone writes.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed
from torch import Tensor

from reenact.errors import ReenactError

_PATIENCE = timedelta(minutes=30)
"""How long a process waits for another that lives; longer than any preparation by the first takes. The death of one is
noticed at once."""


class TeamError(ReenactError):
    """Another process of the team has ended."""


@dataclass(frozen=True)
class Team:
    """This process among those that train together."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this is the process that writes."""
        return self.rank == 0

    def share(self, count: int) -> Tensor:
        """Which of so many items are this process's: every `size`-th."""
        return torch.arange(count)[self.rank :: self.size]

    def add(self, *tensors: Tensor) -> None:
        """Replace each tensor, of one type, by its sum over all processes; all of them get the same bits.

        Raises:
            TeamError: Another process has ended.
        """
        if self.size == 1 or not tensors:
            return
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        with _told():
            torch.distributed.all_reduce(flat)
        for tensor, part in zip(tensors, flat.split([tensor.numel() for tensor in tensors])):
            tensor.copy_(part.view_as(tensor))

    def map(self, function: Callable[[int, Tensor], Tensor], chunks: tuple[Tensor, ...]) -> Tensor:
        """What the function makes of all chunks (rows of something), one below the other; each made by one process.

        Args:
            function: Gets the number of a chunk and its rows; makes as many rows.
            chunks: At least one.
        """
        whole, parts = None, ()
        for place in self.share(len(chunks)).tolist():
            made = function(place, chunks[place])
            if whole is None:
                whole, parts = _room(made, chunks)
            parts[place].copy_(made)
        if self.size == 1:
            return whole
        if whole is None:
            whole, _ = _room(function(0, chunks[0][:1]), chunks)
        with _told():
            torch.distributed.all_reduce(whole)  # to the zeros of the others: no bit changes
        return whole

    def agree(self, text: str | None) -> str:
        """The leader's text, in all processes."""
        if self.size == 1:
            return text or ""
        letters = torch.tensor(list((text or "").encode()), dtype=torch.uint8)  # nothing is pickled
        length = torch.tensor([len(letters)])
        self.follow(length)
        letters = letters if self.leads else torch.empty(int(length), dtype=torch.uint8)
        self.follow(letters)
        return bytes(letters.tolist()).decode()

    def wait(self) -> None:
        """Until all processes have come here.

        Raises:
            TeamError: Another process has ended.
        """
        self.add(torch.zeros(1))

    def follow(self, *tensors: Tensor) -> None:
        """Replace each tensor by the leader's."""
        if self.size > 1:
            with _told():
                for tensor in tensors:
                    torch.distributed.broadcast(tensor, 0)


def _room(made: Tensor, chunks: tuple[Tensor, ...]) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Zeros for what is made of all chunks, whole and chunk by chunk; all at once, for a list of parts and their
    sum would take twice the memory."""
    whole = made.new_zeros(sum(map(len, chunks)), *made.shape[1:])
    return whole, whole.split([len(chunk) for chunk in chunks])


@contextmanager
def team(patience: timedelta = _PATIENCE) -> Iterator[Team]:
    """The processes that torchrun started, or this one alone, for the length of a `with` block.

    Args:
        patience: How long one waits for another that lives.

    Raises:
        TeamError: They do not find each other.
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1 or not torch.distributed.is_torchelastic_launched():
        yield Team()
        return
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
    with _told():
        torch.distributed.init_process_group(
            "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo", timeout=patience
        )
    try:
        yield Team(torch.distributed.get_rank(), torch.distributed.get_world_size())
    finally:
        torch.distributed.destroy_process_group()


@contextmanager
def _told() -> Iterator[None]:
    """What PyTorch says of processes that are gone, as one sentence."""
    try:
        yield
    except RuntimeError as error:
        first = (
            re.sub(r"\[[^\]]*\](:\d+)?\s*", "", str(error).splitlines()[0]).partition(". ")[0].strip()
        )  # without files and addresses
        raise TeamError(
            f"processes: expected all that train together to live, got one that ended ({first[:200]}); the last "
            "checkpoint is intact, go on with --resume, with as many processes as you like"
        ) from error
