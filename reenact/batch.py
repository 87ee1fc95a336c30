"""run_batch(): many clips on many rigs, each by itself; what came of them in one table.

A manifest has an item a row, in .csv, .json (a list of objects) or .toml ([[item]]):

clip, out                       as `reenact infer` takes them; both are needed
run, from, to                   networks that were trained, and the rigs of a cast
checkpoint                      of the run: newest, best or a step
method, source, target          or a geometric method; correspondence may name its pairs of places
fps                             of the result

The table is a .csv with an item a row: clip, out, state (ok or failed), frames, seconds, error, and a digest of the
item. Rows are appended as items end, by all processes that torchrun started, so that a batch that was stopped goes on:
what is ok in the table and lies where it should is not made again, what failed is tried again.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import time
import traceback
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

from reenact.atomic import write_atomically
from reenact.config import read_table
from reenact.data import check_device
from reenact.errors import MissingError, ReenactError
from reenact.folder import load_run_config
from reenact.inference import ImageRetargeter
from reenact.postprocessing import postprocess
from reenact.retargeting import METHODS
from reenact.retargeting.correspondence import find_correspondence, load_correspondence
from reenact.rigs.files import load_clip, load_rig, save_clip
from reenact.rigs.formats import table
from reenact.rigs.timeline import resampled
from reenact.team import team

_HELD = 4
"""Retargeters that a process keeps for later items; each has networks or matrices of two rigs."""
_MARKERS = 300
"""Pairs of places that are found for a geometric method."""
_COLUMNS = ("item", "clip", "out", "state", "frames", "seconds", "error", "digest")
_NAMES = {"from": "source_in_run", "to": "target_in_run"}
"""Keys of a manifest that Python does not take for fields."""


@dataclass(frozen=True)
class Item:
    """One clip to move; None is what the manifest left out."""

    clip: str
    out: str
    run: str | None = None
    source_in_run: str | None = None
    target_in_run: str | None = None
    method: str | None = None
    source: str | None = None
    target: str | None = None
    correspondence: str | None = None
    fps: float | None = None
    checkpoint: str | None = None

    @property
    def digest(self) -> str:
        """What tells the item from others."""
        told = asdict(self)
        if self.checkpoint is None:
            del told["checkpoint"]  # as tables of before the key have it
        return hashlib.sha256(json.dumps(told).encode()).hexdigest()[:16]

    @property
    def mover(self) -> tuple[str | None, ...]:
        """What items have in common that one retargeter moves."""
        kinds = (self.run, self.checkpoint, self.source_in_run, self.target_in_run, self.method)
        return *kinds, self.source, self.target, self.correspondence


def read_manifest(path: Path) -> list[Item]:
    """The items of a manifest.

    Raises:
        MissingError: There is no such file.
        ReenactError: Another suffix or content, an unknown key, an item that lacks something, two that write one file.
    """
    if not path.is_file():
        raise MissingError(f"{path}: there is no such manifest; write a .csv with the columns run, clip and out")
    suffix = path.suffix.lower()
    if suffix == ".csv":
        titles, body = table.rows(path)
        rows = [{key: cell for key, cell in zip(titles, row) if cell} for row in body]
    elif suffix == ".toml":
        rows = read_table(path).get("item")
    elif suffix == ".json":
        try:
            rows = json.loads(path.read_bytes())
        except (ValueError, RecursionError) as error:
            raise ReenactError(f"{path}: expected JSON, got something else ({error})") from error
    else:
        raise ReenactError(f"{path}: expected a manifest in .csv, .json or .toml, got {suffix or 'no suffix'}")
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) for row in rows):
        raise ReenactError(f"{path}: expected a list of items, got something else or none; see `reenact batch --help`")
    items = [_item(f"{path}: item {number}", row) for number, row in enumerate(rows, 1)]
    for out, count in Counter(os.path.abspath(item.out) for item in items).items():
        if count > 1:
            raise ReenactError(f"{path}: expected an out of its own for each item, got {out} {count} times")
    return items


def _item(where: str, row: dict[str, Any]) -> Item:
    known = {key: _NAMES.get(key, key) for key in ("clip", "out", "run", "from", "to", "method", "source", "target")}
    known |= {key: key for key in ("checkpoint", "correspondence", "fps")}
    strange = [key for key in row if key not in known]
    if strange:
        raise ReenactError(f"{where}: expected keys among {', '.join(known)}, got {strange[0]}")
    fields = {known[key]: value for key, value in row.items()}
    if type(fields.get("checkpoint")) is int:
        fields["checkpoint"] = str(fields["checkpoint"])
    try:
        fps = None if "fps" not in fields else float(fields.pop("fps"))
    except (TypeError, ValueError):
        fps = -1.0
    if fps is not None and not 0 < fps <= 1000:
        raise ReenactError(f"{where}: expected fps above 0, up to 1000, got {row['fps']}")
    wrong = [key for key, value in fields.items() if not (isinstance(value, str) and value)]
    if wrong or "clip" not in fields or "out" not in fields:
        raise ReenactError(f"{where}: expected clip and out, and texts, got {wrong[0] if wrong else ', '.join(row)}")
    item = Item(**fields, fps=fps)
    if item.run is None and None in (item.method, item.source, item.target):
        raise ReenactError(f"{where}: expected a run, or a method with source and target, got {', '.join(row)}")
    if item.run is not None and (item.source or item.target or (item.correspondence and not item.method)):
        raise ReenactError(f"{where}: expected from and to beside a run, got source, target or correspondence")
    if item.checkpoint is not None and (item.run is None or item.method is not None):
        raise ReenactError(f"{where}: expected the networks of a run beside checkpoint, got {', '.join(row)}")
    if item.method is not None and item.method not in METHODS:
        raise ReenactError(f"{where}: expected a method among {', '.join(METHODS)}, got {item.method}")
    return item


def run_batch(
    manifest: Path, results: Path, say: Callable[[str], None] = lambda _: None, device: str = "cpu"
) -> tuple[int, list[dict[str, Any]]]:
    """Move all clips of a manifest that are not done yet.

    Under torchrun each process takes every so-manieth item; all of them end when the last item has.

    Args:
        manifest: See `read_manifest`. Its paths are those of the folder where the command runs.
        results: The table, a .csv.
        say: Told of each item of this process that ended.
        device: Where the networks of runs look at pictures.

    Returns:
        How many items failed, and the rows of the table in the order of the manifest.

    Raises:
        ReenactError: The manifest is wrong, the table is another file, or the device is not there.
        OSError: The table cannot be written.
    """
    check_device(device)
    items = read_manifest(manifest)
    with team(timedelta(days=30)) as workers:
        if workers.leads:
            _write(results, _rows(results))  # without what a power cut tore
        workers.wait()
        done = {row["digest"] for row in _rows(results) if row["state"] == "ok" and Path(row["out"]).is_file()}
        workers.wait()  # all have read it
        movers: OrderedDict[tuple, Any] = OrderedDict()
        todo = [number for number, item in enumerate(items) if item.digest not in done]
        for number in [todo[place] for place in workers.share(len(todo)).tolist()]:
            row = {"item": number + 1, "clip": items[number].clip, "out": items[number].out}
            row |= _made(items[number], movers, device) | {"digest": items[number].digest}
            _append(results, row)
            say(f"{row['out']}: {row['state']}" + f", {row['error']}" * bool(row["error"]))
        workers.wait()
        rows = {row["digest"]: row for row in _rows(results)}
        ordered = [rows[item.digest] | {"item": number} for number, item in enumerate(items, 1) if item.digest in rows]
        workers.wait()  # all have read it
        if workers.leads:
            _write(results, ordered)
    return sum(row["state"] != "ok" for row in ordered), ordered


def _made(item: Item, movers: OrderedDict[tuple, Any], device: str) -> dict[str, Any]:
    """What came of an item; nothing that goes wrong with it is raised."""
    started = time.perf_counter()

    def ended(state: str, frames: int = 0, error: str = "") -> dict[str, Any]:
        seconds = round(time.perf_counter() - started, 3)
        return {"state": state, "frames": frames, "seconds": seconds, "error": " ".join(error.split())}

    try:
        return ended("ok", _move(item, movers, device))
    except ReenactError as error:
        return ended("failed", error=str(error))
    except OSError as error:
        return ended("failed", error=f"{error.filename or item.out}: {error.strerror or error}")
    except MemoryError:
        return ended("failed", error="expected more memory than there is; take a shorter clip or smaller rigs")
    except Exception as error:  # ours, and no reason to stop the others
        traceback.print_exc()
        return ended("failed", error=f"a fault in Reenact, please report it: {type(error).__name__}: {error}")


def _move(item: Item, movers: OrderedDict[tuple, Any], device: str) -> int:
    """Write an item's clip; how many frames it has."""
    if not Path(item.out).parent.is_dir():
        raise MissingError(f"{item.out}: the folder {Path(item.out).parent} does not exist; make it first")
    if item.mover not in movers:
        while len(movers) >= _HELD:
            movers.popitem(last=False)
        movers[item.mover] = _mover(item, device)
    movers.move_to_end(item.mover)
    retargeter, origin = movers[item.mover]
    moved = retargeter(load_clip(item.clip, retargeter.source))
    moved = moved if item.fps in (None, moved.fps) else resampled(moved, item.fps)
    if item.run is not None:
        moved = postprocess(moved, load_run_config(item.run).post)
    save_clip(moved, item.out, retargeter.target, origin if Path(origin).is_file() else None)
    return len(moved)


def _mover(item: Item, device: str) -> tuple[Any, str]:
    """What moves an item's clip, and where the target came from."""
    if item.run is not None:
        named = {"source": item.source_in_run, "target": item.target_in_run, "device": device}
        found = ImageRetargeter.load(item.run, **named, checkpoint=item.checkpoint or "newest")
        origin = dict(zip(found.run.keys, found.run.config.rigs))[found.keys[1]]
        if item.method is None:
            return found, origin
        rigs, pairs = (found.source, found.target), found.run.correspondence(*found.keys)
    else:
        rigs, pairs, origin = (load_rig(item.source), load_rig(item.target)), None, item.target
    if item.correspondence is not None:
        pairs = load_correspondence(item.correspondence, *rigs)
    elif pairs is None and item.method not in ("copy", "neutral"):
        pairs = find_correspondence(*rigs, _MARKERS)
    return METHODS[item.method](*rigs, pairs, None), origin


def _rows(path: Path) -> list[dict[str, str]]:
    """The rows of a table; none where there is no table yet. A row that a power cut tore is left out."""
    if not path.exists():
        return []
    titles, *body = [next(csv.reader([line]), []) for line in path.read_text(errors="replace").splitlines()] or [[]]
    if tuple(titles) != _COLUMNS:
        raise ReenactError(f"{path}: expected the table of a batch, got another file; name another with --results")
    return [dict(zip(_COLUMNS, row)) for row in body if len(row) == len(_COLUMNS) and len(row[-1]) == 16]


def _write(path: Path, rows: list[dict[str, Any]]) -> None:
    write_atomically(path, _text([_COLUMNS, *([row[name] for name in _COLUMNS] for row in rows)]))


def _append(path: Path, row: dict[str, Any]) -> None:
    """One write at the end of the file, so that several processes do not mix their rows."""
    with open(path, "ab", buffering=0) as file:
        file.write(_text([[row[name] for name in _COLUMNS]]))
        os.fsync(file.fileno())


def _text(rows: list) -> bytes:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()
