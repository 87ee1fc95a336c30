"""Checkpoint: everything a run needs to go on, on disk, never half of it.

A checkpoint is one safetensors file: tensors, and in its header a JSON text with the step and the rest of the state,
and a SHA-256 of it all. One file, so that no crash leaves tensors of one step beside the state of another. Nothing here
reads or writes pickle: a checkpoint from a stranger cannot run code.

    run/checkpoints/step-00000500.safetensors
    run/checkpoints/best                        name of the one whose networks erred least, and by how much
    run/checkpoints/latest                      name of the newest, written after the others
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import random
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor

from reenact.atomic import sweep, write_atomically
from reenact.errors import MissingError, ReenactError

FORMAT = 1
"""Version of the layout of a checkpoint; raised by a change that older code cannot read."""

_FILE_NAME = re.compile(r"step-(\d{8,})\.safetensors")


@dataclass(frozen=True)
class Checkpoint:
    """What a run was at one step."""

    step: int
    """Optimizer steps done."""
    tensors: dict[str, Tensor]
    """Parameters, moments and the like by flat name, on the CPU."""
    state: dict[str, Any]
    """Everything that is not a tensor, as it comes out of JSON: tuples have become lists."""
    error: float | None = None
    """How wrong the networks were in a check that all checkpoints pass alike; None where there was none."""


def save_checkpoint(
    run_dir: Path,
    step: int,
    tensors: dict[str, Tensor],
    state: dict[str, Any],
    *,
    error: float | None = None,
    keep: int = 3,
    milestones: int = 0,
) -> Path:
    """The file of a new checkpoint; older ones are removed once it is safe on disk, but for the best and milestones.

    Each file tells its own error. Which is the best is found anew at every save, from the files that are there: what a
    crash, another version or a hand did to the pointer does not matter.

    Args:
        run_dir: Folder of the run.
        step: Optimizer steps done.
        tensors: By flat name; on any device.
        state: Ready for JSON.
        error: As in `Checkpoint`; what is not finite counts as none.
        keep: Newest checkpoints up to this step that stay.
        milestones: Checkpoints at multiples of so many steps stay for ever; 0 for none.

    Raises:
        OSError: No space, no permission; every earlier checkpoint is still there.
    """
    folder = run_dir / "checkpoints"
    folder.mkdir(parents=True, exist_ok=True)
    sweep(folder)
    copies = _copies(tensors)
    content = {"format": FORMAT, "step": step, "state": state}
    if error is not None and math.isfinite(error):
        content["error"] = error
    text = json.dumps(content)
    header = {"reenact": text, "sha256": _digest(copies, text)}
    path = folder / f"step-{step:08d}.safetensors"
    write_atomically(path, safetensors.torch.save(copies, metadata=header))
    # Later steps than this one are left alone: they are of a run that went back, and its next saves replace them.
    known = [file for file in _checkpoints(run_dir) if _step(file) <= step]
    ranked = _best_first(known)
    if ranked:  # before `latest`: a run that is killed in between saves this step again
        best, least = ranked[0]
        write_atomically(folder / "best", f"{best.name} {least!r}\n".encode())
    write_atomically(folder / "latest", f"{path.name}\n".encode())
    stay = {*known[-keep:], *(file for file, _ in ranked[:1])}
    for old in known:
        if old not in stay and not (milestones and _step(old) % milestones == 0):
            old.unlink(missing_ok=True)
    return path


def load_checkpoint(run_dir: Path, which: str = "newest") -> Checkpoint:
    """A checkpoint of a run that is whole; warns when another one that comes first is not.

    Args:
        run_dir: Folder of the run.
        which: The "newest", the "best" by the errors that they tell, or that of a step, as digits.

    Raises:
        MissingError: The run has saved none yet, or there is no such run.
        ReenactError: There is no such checkpoint, it cannot be read, or a newer version of Reenact wrote it.
    """
    paths = _newest_first(run_dir)
    if not paths:
        raise MissingError(f"{run_dir}: expected checkpoints in {run_dir / 'checkpoints'}, got none; train it first")
    if which != "newest":
        paths = _chosen(run_dir, which)
    for index, path in enumerate(paths):
        try:
            checkpoint = _read(path)
        except (OSError, _Torn) as error:
            verb = "going on from" if which == "newest" else "taking"
            following = f"; {verb} {paths[index + 1].name}" if index + 1 < len(paths) else ""
            warnings.warn(f"{path}: expected a whole checkpoint, got a damaged one ({error}){following}", stacklevel=2)
        else:
            return checkpoint
    others = "" if which == "newest" else ", take another checkpoint"
    raise ReenactError(
        f"{run_dir}: expected a whole checkpoint, got {len(paths)} damaged ones; restore the folder{others} or train "
        "again"
    )


def best_checkpoint(run_dir: Path) -> tuple[int, float] | None:
    """Steps and error of the best checkpoint that is there, of those up to the newest; None where none tells."""
    ranked = _best_first(_up_to_newest(run_dir))
    return (_step(ranked[0][0]), ranked[0][1]) if ranked else None


def has_checkpoint(run_dir: Path) -> bool:
    """Whether the run has saved anything."""
    return bool(_checkpoints(run_dir))


def newest_step(run_dir: Path) -> int | None:
    """Steps of the checkpoint that `load_checkpoint` tries first; None before the first."""
    paths = _newest_first(run_dir)
    return _step(paths[0]) if paths else None


def save_tensors(tensors: dict[str, Tensor], path: Path) -> None:
    """Write named tensors alone, as safetensors, atomically.

    Raises:
        OSError: No space, no permission; what was there before still is.
    """
    write_atomically(path, safetensors.torch.save(_copies(tensors)))


def load_tensors(path: Path) -> dict[str, Tensor]:
    """The tensors of a safetensors file.

    Raises:
        MissingError: There is no such file.
        ReenactError: It is not a safetensors file, or a damaged one.
    """
    if not path.is_file():
        raise MissingError(f"{path}: there is no such file; restore the run folder or train again")
    try:
        return safetensors.torch.load(path.read_bytes())
    except (SafetensorError, ValueError, KeyError) as error:
        raise ReenactError(
            f"{path}: expected tensors, got a damaged file ({error}); restore it or train again"
        ) from error


class _Torn(Exception):
    """This file is not what was saved."""


def _read(path: Path) -> Checkpoint:
    data = path.read_bytes()  # not mapped: the file may be replaced while its tensors are in use
    try:
        tensors = safetensors.torch.load(data)
        # `load` has checked that the header fits the file, but does not hand out its texts.
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]
        content = json.loads(header["reenact"])
        version, step, state = content["format"], content["step"], content["state"]
        digest = header["sha256"]
        if not (isinstance(version, int) and isinstance(step, int) and isinstance(state, dict)):
            raise _Torn("its header lacks format, step or state")
    # RuntimeError: JSON nested too deep; the others: the header is JSON, but of another kind.
    except (SafetensorError, RuntimeError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise _Torn(str(error) or type(error).__name__) from error
    if digest != _digest(tensors, header["reenact"]):  # the same in every format, so checked before it
        raise _Torn("its SHA-256 differs from what was saved")
    if version > FORMAT:
        raise ReenactError(
            f"{path}: expected a checkpoint of format {FORMAT} or older, got {version}; update Reenact to read it"
        )
    return Checkpoint(step=step, tensors=tensors, state=state, error=_told_error(content))


def _copies(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Parameters may share memory, or lie in another order; safetensors refuses both."""
    return {name: tensor.detach().to("cpu", copy=True).contiguous() for name, tensor in tensors.items()}


def _digest(tensors: dict[str, Tensor], text: str) -> str:
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"\n{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def _checkpoints(run_dir: Path) -> list[Path]:
    """Files of checkpoints, oldest first."""
    folder = run_dir / "checkpoints"
    return sorted((file for file in folder.glob("step-*") if _FILE_NAME.fullmatch(file.name)), key=_step)


def _step(path: Path) -> int:
    match = _FILE_NAME.fullmatch(path.name)
    assert match is not None
    return int(match[1])


def _newest_first(run_dir: Path) -> list[Path]:
    """The one that `latest` names, then older ones, then those of an abandoned future."""
    paths = _checkpoints(run_dir)[::-1]
    pointer = run_dir / "checkpoints" / "latest"
    name = pointer.read_text(errors="replace").strip() if pointer.is_file() else ""
    first = next((path for path in paths if path.name == name), paths[0] if paths else None)
    return sorted(paths, key=lambda path: (_step(path) > _step(first), -_step(path)))


def _up_to_newest(run_dir: Path) -> list[Path]:
    """Files of checkpoints, oldest first, without those of an abandoned future."""
    newest = newest_step(run_dir)
    return [path for path in _checkpoints(run_dir) if newest is not None and _step(path) <= newest]


def _best_first(paths: list[Path]) -> list[tuple[Path, float]]:
    """Those that tell their error, with it, the least first; of equal ones the earlier."""
    told = [(path, error) for path in paths if (error := _error(path)) is not None]
    return sorted(told, key=lambda each: (each[1], _step(each[0])))


def _error(path: Path) -> float | None:
    """What a file tells in its header, whose tensors are not read; None from one that is damaged there.

    Raises:
        OSError: The disk fails: a file that cannot be read now may be the best, and must not be removed for it.
    """
    try:
        with path.open("rb") as file:
            size = int.from_bytes(file.read(8), "little")
            if size > path.stat().st_size:
                return None
            return _told_error(json.loads(json.loads(file.read(size))["__metadata__"]["reenact"]))
    except (FileNotFoundError, RuntimeError, ValueError, LookupError, TypeError):  # gone: another process trains
        return None
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


def _told_error(content: Any) -> float | None:
    error = content.get("error") if isinstance(content, dict) else None
    return error if isinstance(error, float) and math.isfinite(error) else None


def _chosen(run_dir: Path, which: str) -> list[Path]:
    """The file of a step; or all that tell their error, the best first, and a word where the pointer lost its own.

    Raises:
        ReenactError: There is no such checkpoint.
    """
    paths, ranked = _checkpoints(run_dir), _best_first(_up_to_newest(run_dir))
    best = ranked[0][0] if ranked else None
    chosen = [path for path, _ in ranked] if which == "best" else []
    if which.isascii() and which.isdecimal():
        chosen = [path for path in paths if _step(path) == int(which[:20])]
    if not chosen:
        steps = ", ".join(f"{_step(path)}{' (best)' * (path == best)}" for path in paths)
        wanted, come = "newest, best or a step that was saved", which[:40] or "nothing"
        if which == "best":
            wanted, come = "one that was checked as it was saved, to be the best", "none"
        raise ReenactError(f"{run_dir}: checkpoint: expected {wanted}, got {come}; there are those of steps {steps}")
    pointer = run_dir / "checkpoints" / "best"
    if which == "best" and pointer.is_file():
        name = (pointer.read_text(errors="replace").split() or [""])[0]
        if name not in {path.name for path in paths}:
            warnings.warn(
                f"{pointer}: expected the name of a checkpoint that is there, got {name[:40] or 'nothing'}; taking "
                f"{chosen[0].name}, the best of those that are",
                stacklevel=3,
            )
    return chosen


def flatten_optimizer(
    optimizer: torch.optim.Optimizer, prefix: str = "optimizer"
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """An optimizer's state as tensors by flat name, and the rest ready for JSON; `restore_optimizer` is the inverse.

    Parameters are known by their index in the order in which the optimizer was given them.
    """
    content = optimizer.state_dict()
    tensors, scalars = {}, {}
    for index, entries in content["state"].items():
        for name, value in entries.items():
            kind = tensors if isinstance(value, Tensor) else scalars
            kind[f"{prefix}.{index}.{name}"] = value
    return tensors, {"groups": content["param_groups"], "scalars": scalars}


def restore_optimizer(
    optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor], state: dict[str, Any], prefix: str = "optimizer"
) -> None:
    """Put back what `flatten_optimizer` took out, bit for bit.

    Args:
        tensors: May hold others beside the optimizer's, as a checkpoint's do.
        state: The second part of what `flatten_optimizer` returned.

    Raises:
        ReenactError: The optimizer has other parameters than the one that was saved.
    """
    content: dict[str, Any] = {"state": {}, "param_groups": []}
    now = optimizer.state_dict()["param_groups"]
    sizes, saved_sizes = [[len(group["params"]) for group in groups] for groups in (now, state["groups"])]
    if sizes != saved_sizes:
        raise ReenactError(
            f"{prefix}: expected a state for {sizes} parameters, got one for {saved_sizes}; "
            f"resume with the run's settings"
        )
    for group, fresh in zip(state["groups"], now, strict=True):
        # JSON has no tuples, and `betas` is one.
        kinds = {key: tuple(value) if isinstance(fresh.get(key), tuple) else value for key, value in group.items()}
        content["param_groups"].append(kinds)
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    own_name = re.compile(rf"{re.escape(prefix)}\.(\d+)\.(.+)")
    for name, value in {**tensors, **state["scalars"]}.items():
        match = own_name.fullmatch(name)
        if match is None:
            continue
        index, key = int(match[1]), match[2]
        shape = tuple(parameters[index].shape) if index < len(parameters) else None
        if (
            isinstance(value, Tensor) and value.dim() and tuple(value.shape) != shape
        ):  # a count of steps has no dimension
            raise ReenactError(
                f"{name}: expected shape {shape}, got {tuple(value.shape)}; resume with the run's settings"
            )
        content["state"].setdefault(index, {})[key] = value.clone() if isinstance(value, Tensor) else value
    optimizer.load_state_dict(content)


Generator = torch.Generator | np.random.Generator


def random_state(**generators: Generator) -> dict[str, Any]:
    """The state of every source of random numbers, ready for JSON.

    Args:
        generators: The run's own, by any name (NumPy's as `default_rng` makes them); the global ones of Python, NumPy
            and PyTorch are always included.
    """
    numpy_state: dict[str, Any] = np.random.get_state(legacy=False)  # noqa: NPY002 - libraries draw from it
    numpy_state["state"] = {"key": numpy_state["state"]["key"].tolist(), "pos": int(numpy_state["state"]["pos"])}
    state: dict[str, Any] = {
        "python": random.getstate(),
        "numpy": numpy_state,
        "torch": _encode(torch.get_rng_state()),
        "cuda": [_encode(each) for each in torch.cuda.get_rng_state_all()] if torch.cuda.is_available() else [],
    }
    own = {
        name: _encode(generator.get_state())
        if isinstance(generator, torch.Generator)
        else generator.bit_generator.state
        for name, generator in generators.items()
    }
    return {"global": state, "own": own}


def restore_random_state(state: dict[str, Any], **generators: Generator) -> None:
    """Put back what `random_state` took out: the same numbers follow.

    Raises:
        ReenactError: The state is of other generators.
    """
    if set(generators) != set(state["own"]):
        raise ReenactError(
            f"random state: expected generators {sorted(generators)}, got {sorted(state['own'])}; "
            f"resume with the version of Reenact that saved it"
        )
    everyone = state["global"]
    version, key, gauss = everyone["python"]
    random.setstate((version, tuple(key), gauss))
    numpy_state = everyone["numpy"]
    numpy_key = np.array(numpy_state["state"]["key"], dtype=np.uint32)
    np.random.set_state({**numpy_state, "state": {**numpy_state["state"], "key": numpy_key}})  # noqa: NPY002
    torch.set_rng_state(_decode(everyone["torch"]))
    if torch.cuda.is_available() and len(everyone["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all([_decode(each) for each in everyone["cuda"]])
    for name, generator in generators.items():
        if isinstance(generator, torch.Generator):
            generator.set_state(_decode(state["own"][name]))
        else:
            generator.bit_generator.state = state["own"][name]


def _encode(state: Tensor) -> str:
    return base64.b64encode(state.numpy().tobytes()).decode()


def _decode(text: str) -> Tensor:
    return torch.frombuffer(bytearray(base64.b64decode(text)), dtype=torch.uint8)
