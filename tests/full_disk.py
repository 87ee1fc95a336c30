"""Commands on a full disk: `unshare --user --map-root-user --mount python full_disk.py FOLDER`, to mount small ones.

Prints as JSON what was tried and what went wrong.
"""

import contextlib
import importlib.util
import io
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import torch
from lives import differs, outcome, settings

from reenact.checkpoint import has_checkpoint, load_checkpoint
from reenact.cli import main as reenact
from reenact.config import save_config
from reenact.rigs.clip import Clip
from reenact.rigs.files import load_rig, save_clip
from reenact.run import Run


def mount(disk: Path, kibibytes: int, again: bool = False) -> None:
    """A disk of that size; `again` enlarges the one that is there."""
    options = f"{'remount,' if again else ''}size={kibibytes}k"
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", disk], check=True)


def said(arguments: list) -> tuple[int, str]:
    """Exit status and message of a command."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = reenact([str(argument) for argument in arguments])
    return status, "\n".join(line for line in err.getvalue().splitlines() if line.startswith("error: "))


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    disk, found = folder / "disk", {"tried": 0, "wrong": [], "said": []}
    disk.mkdir()
    config = settings(folder, 0)
    save_config(replace(config, run=str(folder / "whole")), folder / "whole.toml")
    assert said(["train", "--config", folder / "whole.toml"])[0] == 0
    expected = outcome(folder / "whole")

    def check(what: str, status: int, error: str) -> None:
        found["tried"] += 1
        found["said"].append(error)
        if status != 2 or not any(words in error for words in ("No space left on device", "is the disk full?")):
            found["wrong"].append(f"{what}: exit {status}, {error!r}")

    # Too small for the run itself; for the first checkpoint; for a later one.
    for size in (60, 190, 320):
        mount(disk, size)
        save_config(replace(config, run=str(disk / "run")), folder / "x.toml")
        check(f"train on {size} KiB", *said(["train", "--config", folder / "x.toml"]))
        found["wrong"] += [f"left behind: {path}" for path in disk.rglob("*.tmp")]
        if (disk / "run").exists():
            Run.open(disk / "run")
            if has_checkpoint(disk / "run"):
                load_checkpoint(disk / "run")
            mount(disk, 10_000, again=True)
            status, error = said(["train", "--run", disk / "run", "--resume"])
            if status or differs(expected, outcome(disk / "run"), ("tensors", "metrics", "moved")):
                found["wrong"].append(f"resumed from {size} KiB: exit {status}, {error!r}")
        elif list(disk.iterdir()):
            found["wrong"].append(f"left behind on {size} KiB: {list(disk.iterdir())}")
        subprocess.run(["umount", disk], check=True)

    rig = load_rig(config.source)
    weights = torch.rand(120, len(rig.names), generator=torch.Generator().manual_seed(0))
    save_clip(Clip(rig.names, weights, 30.0), folder / "clip.npz")
    films = ["film.gif", "pictures"] + ["film.mp4"] * (importlib.util.find_spec("imageio_ffmpeg") is not None)
    exports = [(["convert", config.source, disk / f"x.{kind}"], f"x.{kind}") for kind in ("glb", "npz", "usda")]
    drawn = [
        ["render", folder / "clip.npz", "--rig", config.source, "--size", 64, "--out", disk / name] for name in films
    ]
    for arguments, name in exports + list(zip(drawn, films)):
        for old in (False, True):  # what is there already stays
            mount(disk, 8)
            if old and "." in name:
                (disk / name).write_text("old")
            check(f"{arguments[0]} {name}", *said(arguments))
            kept = [(path.name, path.read_text()) for path in disk.iterdir() if path.is_file()]
            if kept != ([(name, "old")] if old and "." in name else []) or any(map(Path.is_dir, disk.iterdir())):
                found["wrong"].append(f"{arguments[0]} {name}: left {sorted(each.name for each in disk.rglob('*'))}")
            subprocess.run(["umount", disk], check=True)
    shutil.rmtree(folder / "whole")
    print(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
