"""The format of a run folder, and the settings in it, whatever version of Reenact wrote them.

format.json          {"format": 2, "reenact": "0.2.0"}: the layout of the folder, and the version that made it so

The format counts changes after which older code would misread a folder, or newer code an older folder. A folder of an
older format is read as one of today's by the steps below, in memory; a run that is trained on is also rewritten, under
its lock. What no step leads from is refused with the version that opens it, and so is a newer format.

Whoever changes what a run folder holds, or adds, renames or removes a setting or gives it another meaning, raises
`FORMAT`, adds a step, and stores a small run of the old format in tests/fixtures (tests/make_fixture_run.py).
"""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from reenact.atomic import write_atomically
from reenact.config import Config, check_config, config_from_dict, read_table, save_config
from reenact.errors import MissingError, ReenactError

FORMAT = 2
"""Of the folders that this version writes."""


def reenact_version() -> str:
    """The installed version, "unknown" where the code runs without being installed."""
    try:
        return importlib.metadata.version("reenact")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def check_run(folder: Path | str) -> None:
    """Refuse what is no run folder, before any work.

    Raises:
        MissingError: There is no config.toml in it.
    """
    if not (Path(folder) / "config.toml").is_file():
        raise MissingError(
            f"{folder}: expected a run folder with config.toml in it, got none; `reenact train` makes one"
        )


def load_run_config(folder: Path | str) -> Config:
    """The settings of the run in a folder, as this version understands them; `run` is the folder itself.

    Raises:
        MissingError: There is no run.
        ReenactError: The run is of a format that this version does not open, or its settings are damaged.
    """
    folder = Path(folder)
    check_run(folder)
    path = folder / "config.toml"
    found = run_format(folder)
    table = read_table(path)
    for step in range(found, FORMAT):
        table = _STEPS[step](table, folder)
    config = config_from_dict(table, origin=str(path))
    check_config(config, origin=str(path))
    return replace(config, run=str(folder))


def run_format(folder: Path) -> int:
    """The format of a run folder; 0 for those of before formats were written down.

    Raises:
        ReenactError: It is newer than this version, or not a format at all.
    """
    path = folder / "format.json"
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        return 0
    except (ValueError, RecursionError) as error:
        content = error
    number = content.get("format") if isinstance(content, dict) else None
    if type(number) is not int or number < 1:
        raise ReenactError(
            f'{path}: expected {{"format": {FORMAT}}} or alike, got something else; restore the file, or delete it if '
            f"Reenact {reenact_version()} made the run"
        )
    if number > FORMAT:
        raise ReenactError(
            f"{folder}: expected a run of format {FORMAT} or older, got format {number}, which Reenact "
            f"{content.get('reenact', 'of a later version')} wrote; open it with that version or a newer one"
        )
    return number


def write_format(folder: Path) -> None:
    """Mark a folder as one of this version's."""
    content = {"format": FORMAT, "reenact": reenact_version()}
    write_atomically(folder / "format.json", f"{json.dumps(content)}\n".encode())


def migrate(folder: Path, config: Config) -> None:
    """Rewrite a folder of an older format as one of this version's; the caller holds the run's lock.

    Args:
        folder: The run.
        config: What `load_run_config` made of it.
    """
    if run_format(folder) < FORMAT:
        save_config(config, folder / "config.toml")  # first: a folder that is marked must hold what the mark says
        write_format(folder)


def _from_0(table: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Before formats: 0.1.0 and development versions after it. The first had other networks."""
    training = table.get("training")
    if "pairs" not in table or not isinstance(training, dict):
        raise ReenactError(
            f"{folder}: expected a run of format {FORMAT} or one of shortly before it, got one of Reenact 0.1.0, whose "
            "networks were others; open it with Reenact 0.1.0, or train again"
        )
    return {**table, "training": {"together": False, **training}}  # stages, where the setting was not known yet


def _from_1(table: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Before BPNet's answers were bounded and steadied, and crowded expressions uneven."""
    for name, added in (("bpnet", {"bounded": False, "steady": 0.0}), ("training", {"uneven": 0.0})):
        section = table.get(name, {})
        if isinstance(section, dict):  # what is not is refused later
            table = {**table, name: {**added, **section}}
    return table


_STEPS: dict[int, Callable[[dict[str, Any], Path], dict[str, Any]]] = {0: _from_0, 1: _from_1}
"""By format: its settings as those of the next format."""
