"""TensorBoard, for those who watch trainings there: losses as scalars, previews as pictures. An extra."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from reenact.errors import ReenactError


def require() -> None:
    """Do nothing where TensorBoard can be imported.

    Raises:
        ReenactError: It is not installed.
    """
    if importlib.util.find_spec("tensorboard") is None:
        raise ReenactError(
            "training.tensorboard: expected TensorBoard, which is not installed; pip install 'reenact[tensorboard]', "
            "or leave the setting out"
        )


class Board:
    """Writes events into RUN/tensorboard, or nothing at all unless it is wanted; a context manager."""

    def __init__(self, folder: Path, wanted: bool, step: int = 0):
        """
        Args:
            folder: Of the run.
            wanted: Whether to write anything.
            step: The first, counted over all stages; what an earlier process wrote of later ones is not shown.

        Raises:
            ReenactError: TensorBoard is wanted and not installed.
        """
        self.writer: Any = None
        if wanted:
            require()
            from torch.utils.tensorboard import SummaryWriter

            purge = step + 1 if step else None
            self.writer = SummaryWriter(str(folder / "tensorboard"), purge_step=purge, flush_secs=10)

    def __enter__(self) -> Board:
        return self

    def __exit__(self, *_: object) -> None:
        if self.writer is not None:
            self.writer.close()

    def scalars(self, stage: str, before: int, step: int, values: dict[str, float]) -> None:
        """Numbers of a step of a stage, which `before` steps of other stages went before."""
        if self.writer is not None:
            for name, value in values.items():
                self.writer.add_scalar(f"{stage}/{name}", value, before + step)

    def picture(self, path: Path, step: int) -> None:
        """A preview, at a step counted over all stages."""
        if self.writer is not None:
            with Image.open(path) as picture:
                self.writer.add_image("preview", np.asarray(picture.convert("RGB")), step, dataformats="HWC")
