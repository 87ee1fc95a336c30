"""What an installation can do, and what to do where it cannot: the checks behind `reenact doctor`."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from packaging.requirements import Requirement
from packaging.version import Version

from reenact.folder import reenact_version

PICTURE = Path(__file__).with_name("doctor.png")
"""What the renderer should draw; `save_picture` made it."""
_TOLERANCE = 2 / 255
"""Between the picture and what is drawn: rounding to 8 bits, and other processors' last bits."""
_RUN_BYTES = 2e9
"""Disk that a training with its checkpoints may need."""

EXTRAS = {
    "gltf": ("DracoPy", "meshopt", "compressed glTF"),
    "fbx": ("ufbx", "FBX files"),
    "usd": ("pxr", "USD files"),
    "mocap": ("c3d", ".c3d markers"),
    "patches": ("pymetis", "more even patches in AnaConDaR"),
    "video": ("imageio_ffmpeg", ".mp4 films"),
    "opengl": ("pyrender", "--opengl, large pictures drawn by OpenGL"),
    "tensorboard": ("tensorboard", "training.tensorboard"),
    "docs": ("sphinx", "myst_parser", "furo", "make docs"),
    "dev": ("pytest", "ruff", "playwright", "tests of Reenact itself"),
}
"""By extra: modules that it brings, then what for."""


@dataclass(frozen=True)
class Finding:
    """One line of what was found."""

    name: str
    state: Literal["ok", "missing", "wrong"]
    found: str
    remedy: str = ""
    """What to do; empty where all is well."""
    needed: bool = True
    """Whether Reenact does not work without it."""


def examine(folder: Path) -> list[Finding]:
    """All checks, in order. A check that fails in a way that nobody thought of is a finding as well.

    Args:
        folder: Where runs and results are to lie.
    """
    checks: list[tuple[str, Callable[[], list[Finding]]]] = [
        ("Python", lambda: [_python()]),
        ("packages", _packages),
        ("threads", lambda: [_threads()]),
        ("compiler", lambda: [_compiler()]),
        ("compiled code", lambda: [_compiled_code()]),
        ("renderer", lambda: [_renderer()]),
        ("GPU", lambda: [_gpu()]),
        ("files here", lambda: [_writable("files here", folder)]),
        ("disk", lambda: [_space(folder)]),
        ("locks", lambda: [_locks(folder)]),
        ("cache", lambda: [_cache()]),
        ("extras", lambda: [_extra(name) for name in _extras()]),
    ]
    findings: list[Finding] = []
    for name, check in checks:
        try:
            findings += check()
        except Exception as error:
            words = " ".join(str(error).split())[:300]
            remedy = "install Reenact anew in a fresh environment; if that does not help, report this line"
            findings.append(Finding(name, "wrong", f"{type(error).__name__}: {words}", remedy, needed=name != "GPU"))
    return findings


def healthy(findings: list[Finding]) -> bool:
    """Whether all that is needed is there and right."""
    return all(finding.state == "ok" for finding in findings if finding.needed)


def _python() -> Finding:
    found = f"{sys.version.split()[0]} on {sys.platform}, Reenact {reenact_version()} in {Path(__file__).parent}"
    return Finding("Python", "ok", found)  # an older one could not read this file


def _packages() -> list[Finding]:
    """Each package that Reenact asks for, at the version that it asks for."""
    try:
        texts = importlib.metadata.requires("reenact") or []
    except importlib.metadata.PackageNotFoundError:
        remedy = "pip install --editable . in its folder, so that versions can be checked"
        return [Finding("packages", "missing", "Reenact runs without being installed", remedy, needed=False)]
    findings = []
    for requirement in map(Requirement, texts):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            findings.append(Finding(requirement.name, "missing", "none", f"pip install '{requirement}'"))
            continue
        fits = requirement.specifier.contains(Version(version), prereleases=True)
        found = version if fits else f"{version}, but Reenact needs {requirement.specifier}"
        remedy = "" if fits else f"pip install '{requirement}'"
        findings.append(Finding(requirement.name, "ok" if fits else "wrong", found, remedy))
    return findings


def _threads() -> Finding:
    import torch

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OMP_WAIT_POLICY")
    limits = [f"{name}={os.environ[name]}" for name in names if os.environ.get(name)]
    found = f"{torch.get_num_threads()} of {cores} cores" + f" ({', '.join(limits)})" * bool(limits)
    if torch.get_num_threads() > cores:
        remedy = f"set OMP_NUM_THREADS={cores}, or training.threads: more threads than cores are slower"
        return Finding("threads", "wrong", found, remedy, needed=False)
    return Finding("threads", "ok", found)


def _compiler() -> Finding:
    import numba

    start = time.perf_counter()
    answer = numba.njit(lambda x: x + 1)(41)
    found = f"numba {numba.__version__} compiled a function in {time.perf_counter() - start:.1f} s"
    if answer != 42:
        return Finding(
            "compiler", "wrong", f"{found}, and 41 + 1 became {answer}", "pip install --force-reinstall numba"
        )
    return Finding("compiler", "ok", found)


def _compiled_code() -> Finding:
    """Whether compiled kernels can be kept, or every start waits for them."""
    import render.kernels.cpu as kernels

    place = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(kernels.__file__).parent / "__pycache__")
    finding = _writable("compiled code", place)
    if finding.state != "ok":
        remedy = "set NUMBA_CACHE_DIR to a folder that can be written, or every start compiles for a minute"
        return Finding("compiled code", "missing", finding.found, remedy, needed=False)
    return finding


def scene() -> dict[str, Any]:
    """Arguments of `render.render`: a bumpy, coloured ball before a background, on 48 x 48 pixels."""
    import numpy as np
    import torch
    import trimesh

    from render import Camera, Light

    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    points = torch.tensor(np.asarray(ball.vertices), dtype=torch.float32)
    bumpy = points * (1 + 0.15 * torch.sin(60 * points[:, :1]) * torch.cos(50 * points[:, 1:2]))
    return {
        "vertices": bumpy[None],
        "faces": torch.tensor(np.asarray(ball.faces), dtype=torch.int64),
        "camera": Camera.look_at(torch.tensor([0.05, 0.02, 0.6]), torch.tensor([0.003, 0.0017, 0.0]), focal=4.5),
        "light": Light(torch.tensor([0.3, 0.4, 0.8]), 0.2, 0.6, 0.2, 6.0),
        "height": 48,
        "width": 48,
        "colors": 0.5 + 0.4 * torch.sin(40 * points + torch.tensor([0.0, 2.0, 4.0])),
        "background": (0.1, 0.2, 0.3),
    }


def save_picture(path: Path = PICTURE) -> None:
    """Draw the scene anew, for a renderer that is meant to draw otherwise from now on."""
    import numpy as np
    from PIL import Image

    from render import render

    pixels = render(**scene())["color"][0].permute(1, 2, 0).numpy()
    Image.fromarray((pixels * 255).round().astype(np.uint8)).save(path)


def _difference(device: str) -> tuple[float, bool, float]:
    """Largest difference from the stored picture, whether a gradient comes back, and seconds."""
    import numpy as np
    import torch
    from PIL import Image

    from render import render

    arguments, start = scene(), time.perf_counter()
    vertices = arguments["vertices"].to(device).requires_grad_()
    for name in ("faces", "colors"):
        arguments[name] = arguments[name].to(device)
    picture = render(**{**arguments, "vertices": vertices})["color"]
    picture.square().sum().backward()
    gradient = vertices.grad is not None and bool(torch.isfinite(vertices.grad).all() and vertices.grad.any())
    seconds = time.perf_counter() - start
    with Image.open(PICTURE, formats=["PNG"]) as stored:
        expected = np.asarray(stored.convert("RGB"), dtype=np.float32) / 255
    drawn = picture[0].detach().cpu().permute(1, 2, 0).numpy()
    return float(np.abs(drawn - expected).max()), gradient, seconds


def _renderer(device: str = "cpu", name: str = "renderer") -> Finding:
    difference, gradient, seconds = _difference(device)
    found = f"a picture in {seconds:.1f} s, within {255 * difference:.1f} / 255 of the stored one"
    if difference > _TOLERANCE or not gradient:
        found += "" if gradient else ", without a gradient"
        remedy = "remove the __pycache__ folders below render/ and try again; if that does not help, report this line"
        return Finding(name, "wrong", found, remedy, needed=device == "cpu")
    return Finding(name, "ok", found, needed=device == "cpu")


def _gpu() -> Finding:
    import torch

    if not torch.cuda.is_available():
        found = f"none that PyTorch {torch.__version__} can use"
        return Finding("GPU", "missing", found, "nothing to do: training and rendering run on the CPU", needed=False)
    name = torch.cuda.get_device_name(0)
    if not _importable("warp"):
        remedy = "for rendering there: pip install warp-lang; everything else does without"
        return Finding("GPU", "missing", f"{name}, but no Warp to render on it", remedy, needed=False)
    finding = _renderer("cuda", "GPU")
    return Finding("GPU", finding.state, f"{name}: {finding.found}", finding.remedy, needed=False)


def _writable(name: str, folder: Path) -> Finding:
    above = next(each for each in (folder, *folder.absolute().parents) if each.exists())  # what is not there is made
    try:
        with tempfile.TemporaryFile(dir=above) as file:
            file.write(b"0")
    except OSError as error:
        remedy = "go to a folder where you may write"
        return Finding(name, "wrong", f"{above}: {error.strerror or error}", remedy)
    return Finding(name, "ok", f"{folder} can be written")


def _space(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free
    found = f"{free / 1e9:.1f} GB free"
    if free < _RUN_BYTES:
        remedy = f"free some: a training with its checkpoints may need {_RUN_BYTES / 1e9:.0f} GB"
        return Finding("disk", "wrong", found, remedy, needed=free < _RUN_BYTES / 10)
    return Finding("disk", "ok", found)


def _locks(folder: Path) -> Finding:
    """Whether the system keeps two processes apart here; without it their signs of life do."""
    from reenact.lock import try_lock

    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            try_lock(file.fileno())
    except OSError as error:
        remedy = "runs are kept apart by signs of life instead, with a minute's delay after a crash"
        return Finding("locks", "missing", error.strerror or str(error), remedy, needed=False)
    return Finding("locks", "ok", "the file system has them", needed=False)


def _cache() -> Finding:
    from reenact.rigs.anny import _cache_directory

    finding = _writable("cache", _cache_directory())
    if finding.state != "ok":
        remedy = "set REENACT_CACHE to a folder that can be written, or built-in rigs are built at every start"
        return Finding("cache", "missing", finding.found, remedy, needed=False)
    return finding


def _extras() -> list[str]:
    """Names of the extras of the installed version; those that this file knows where it is not installed."""
    try:
        names = importlib.metadata.metadata("reenact").get_all("Provides-Extra") or []
    except importlib.metadata.PackageNotFoundError:
        return list(EXTRAS)
    return [name for name in (*EXTRAS, *sorted(set(names) - set(EXTRAS))) if name != "formats"]  # the sum of three


def _extra(name: str) -> Finding:
    *modules, purpose = EXTRAS.get(name, (f"what pyproject.toml says of {name}",))
    absent = [module for module in modules if not _importable(module)]
    if name not in EXTRAS:
        absent = [each for each in _packages_of(name) if not _installed(each)]
    if not absent:
        return Finding(f"extra {name}", "ok", purpose, needed=False)
    remedy = f"for {purpose}: pip install 'reenact[{name}]'"
    if name == "opengl":
        remedy += ", then pip install --no-deps pyrender==0.1.45, and a GL library (Debian: libosmesa6)"
    return Finding(f"extra {name}", "missing", f"no {', '.join(absent)}", remedy, needed=False)


def _packages_of(extra: str) -> list[str]:
    asked = [Requirement(text) for text in importlib.metadata.requires("reenact") or []]
    return [each.name for each in asked if each.marker is not None and each.marker.evaluate({"extra": extra})]


def _installed(package: str) -> bool:
    try:
        importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def _importable(module: str) -> bool:
    try:
        importlib.import_module(module)
    except Exception:  # installed, but broken, is as good as absent
        return False
    return True
