"""Markers: points tracked on a face over time, as motion capture records them.

Optical capture gives positions of a hundred or so dots that move with the head and vanish when something hides them.
What retargeting wants is how the skin moves: `load_markers` reads a file, converts it to metres and fills short gaps;
`Markers.stabilised` takes the head's own motion away.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from reenact.errors import ReenactError
from reenact.geometry import similarity_fit
from reenact.retargeting.correspondence import Places
from reenact.rigs.formats import disk, npz, table
from reenact.rigs.rig import Rig
from reenact.rigs.timeline import steady

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001}
"""Metres."""

_STEADY = 0.0005
"""Metres: noise of a good capture, below which no marker is steadier than another."""
_ROUNDS = 30
"""Fits of the head; each weighs the markers by how still the one before left them."""


@dataclass(frozen=True)
class Markers:
    """Positions of named markers at a constant frame rate, without gaps.

    Raises:
        ReenactError: Sizes disagree, a position is not finite, a name is doubled, the rate is not positive, or
            there are fewer than three markers.
    """

    names: tuple[str, ...]
    """M names, all different."""
    positions: Float[Tensor, "T M 3"]
    """Metres."""
    fps: float
    """Frames per second."""
    neutral: Float[Tensor, "M 3"]
    """Where the markers are on the face at rest."""

    def __post_init__(self) -> None:
        count = len(self.names)
        if self.positions.shape[1] != count or len(self.neutral) != count:
            raise ReenactError(
                f"markers: expected {count} positions a frame for {count} names, got {self.positions.shape[1]}, and "
                f"{len(self.neutral)} at rest"
            )
        if count < 3 or len(self.positions) == 0:
            raise ReenactError(
                f"markers: expected at least 3 markers and a frame, got {count} and {len(self.positions)}"
            )
        doubled = sorted({name for name in self.names if self.names.count(name) > 1})
        if doubled:
            raise ReenactError(f"markers: names must differ, doubled: {', '.join(doubled)[:200]}")
        if not bool(torch.isfinite(self.positions).all() and torch.isfinite(self.neutral).all()):
            raise ReenactError("markers: positions must be finite, got NaN or infinity; fill the gaps first")
        if not self.fps > 0 or self.fps == float("inf"):
            raise ReenactError(f"markers: expected a positive frame rate, got {self.fps}")

    def __len__(self) -> int:
        """Frames."""
        return len(self.positions)

    @classmethod
    def from_rig(cls, rig: Rig, places: Places, weights: Float[Tensor, "T K"], fps: float) -> Markers:
        """What a capture of a rig would record at some of its places.

        Raises:
            ReenactError: The weights are not the rig's.
        """
        if weights.shape[-1] != len(rig.names):
            raise ReenactError(f"{rig.name}: expected weights (T, {len(rig.names)}), got {tuple(weights.shape)}")
        neutral, deltas = places.of(rig.neutral), places.of(rig.deltas)
        names = tuple(f"marker{index:03d}" for index in range(len(places)))
        return cls(names, neutral + torch.einsum("tk,kmc->tmc", weights, deltas), fps, neutral)

    def chosen(self, names: Sequence[str]) -> Markers:
        """The markers with these names, in this order.

        Raises:
            ReenactError: There is no marker of a name.
        """
        lost = [name for name in names if name not in self.names]
        if lost:
            raise ReenactError(f"markers: expected {lost[0]!r} among {', '.join(self.names)[:200]}")
        order = torch.tensor([self.names.index(name) for name in names])
        return Markers(tuple(names), self.positions[:, order], self.fps, self.neutral[order])

    def head_motion(
        self, head: Sequence[str] | None = None
    ) -> tuple[Float[Tensor, "T 3 3"], Float[Tensor, "T 3"], Float[Tensor, "M"]]:
        """Rotation and translation that take the face at rest to each frame, and how much each marker told of them.

        The markers that keep their distances to each other are on the skull. Which these are is found by turns: fit all
        frames rigidly, weigh each marker by 1 / (square of how far it strays + square of 0.5 mm), fit again.

        Args:
            head: Markers known to be fixed to the skull; only these count then.

        Source: iteratively reweighted least squares on rigid fits (Kabsch 1976); one weight a marker is ours.
        """
        rest, frames = self.neutral.double().numpy(), self.positions.double().numpy()
        weights = np.ones(len(self.names))
        if head is not None:
            weights = np.isin(self.names, self.chosen(head).names).astype(float)
        for _ in range(_ROUNDS if head is None else 1):
            rotations, translations = _rigid_fits(rest, frames, weights)
            if head is None:
                back = np.einsum("tji,tmj->tmi", rotations, frames - translations[:, None])
                # A mean of squares would follow the frames with the widest open jaw.
                stray = np.median(np.linalg.norm(back - rest, axis=2), axis=0)
                last, weights = weights, 1 / (np.square(stray) + _STEADY**2)
                weights = weights / weights.max()
                if np.abs(weights - last).max() < 1e-6:
                    break
        rotations, translations = _rigid_fits(rest, frames, weights)
        kind = self.positions.dtype
        return (
            torch.from_numpy(rotations).to(kind),
            torch.from_numpy(translations).to(kind),
            torch.from_numpy(weights / weights.sum()).to(kind),
        )

    def stabilised(self, head: Sequence[str] | None = None) -> Markers:
        """The same motion of the skin with the head held where it is at rest; see `head_motion`."""
        rotations, translations, _ = self.head_motion(head)
        return replace(self, positions=torch.einsum("tji,tmj->tmi", rotations, self.positions - translations[:, None]))

    def aligned(self, places: Float[Tensor, "M 3"], scaled: bool = False) -> Markers:
        """Turned and shifted, and sized where asked for, so that the markers at rest lie nearest to places of a rig.

        A capture may have +Z up, and its origin anywhere; a rig has +Y up and looks along +Z.
        """
        scale, rotation, translation = similarity_fit(self.neutral, places)
        if not scaled:  # The rotation stays the best one, the means are brought together anew.
            scale = torch.ones_like(scale)
            translation = places.mean(0) - rotation @ self.neutral.mean(0)
        turned = [scale * points @ rotation.T + translation for points in (self.positions, self.neutral)]
        return replace(self, positions=turned[0], neutral=turned[1])


def load_markers(
    path: str | Path, neutral_frame: int = 0, longest_gap: float = 0.25, unit: str | None = None
) -> Markers:
    """The markers in a file; gaps are filled linearly in time.

    .npz    `positions` (T, M, 3), `names` (M,), `fps`; NaN where a marker is lost
    .csv    columns `time` in seconds and NAME.x, NAME.y, NAME.z; empty where a marker is lost
    .c3d    through the package c3d (pip install reenact[mocap]); unlabelled trajectories (*12) are left out

    Args:
        path: The file.
        neutral_frame: Frame in which the face is at rest; negative ones count from the end.
        longest_gap: Seconds; a marker that is lost for longer is left out, with a warning.
        unit: "m", "cm" or "mm"; where None, what a .c3d says, and metres for the others.

    Raises:
        ReenactError: No such file, another suffix, something else in it, or fewer than three markers that are there.
    """
    path = Path(path)
    readers = {".npz": _read_npz, ".csv": _read_csv, ".c3d": _read_c3d}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ReenactError(f"{path}: markers are read from {', '.join(readers)}, got {path.suffix or 'no suffix'}")
    names, positions, fps, own_unit = reader(path)
    unit = unit or own_unit
    if unit.lower() not in UNITS:
        raise ReenactError(f"{path}: expected a unit among {', '.join(UNITS)}, got {unit[:40]!r}; give unit=")
    if len(positions) == 0 or not -len(positions) <= neutral_frame < len(positions):
        raise ReenactError(f"{path}: expected frame {neutral_frame} for the neutral, got {len(positions)} frames")
    if not 0 < fps < 1e6:
        raise ReenactError(f"{path}: expected a positive frame rate, got {fps}")
    filled, kept = _filled(path, names, positions, round(longest_gap * fps))
    values = torch.from_numpy((filled * UNITS[unit.lower()]).astype(np.float32))
    try:
        return Markers(kept, values, float(fps), values[neutral_frame])
    except ReenactError as error:
        raise ReenactError(f"{path}: {error}") from None


def _filled(
    path: Path, names: tuple[str, ...], positions: Float[np.ndarray, "T M 3"], longest: int
) -> tuple[Float[np.ndarray, "T N 3"], tuple[str, ...]]:
    """Positions without gaps, linear in time and held at the ends, of the markers whose gaps are short enough."""
    there = np.isfinite(positions).all(-1)  # (T, M)
    frames = np.arange(len(positions))
    kept, columns, lost, patched = [], [], [], 0
    for index, name in enumerate(names):
        seen = there[:, index]
        edges = np.flatnonzero(np.diff(np.concatenate([[1], seen, [1]])))
        gaps = edges[1::2] - edges[::2]
        if gaps.max(initial=0) > longest or not seen.any():
            lost.append(name)
            continue
        patched += int((~seen).sum())
        kept.append(name)
        columns.append([np.interp(frames, frames[seen], positions[seen, index, axis]) for axis in range(3)])
    if patched or lost:
        left_out = f"; left out, lost for longer than {longest} frames: {', '.join(lost)[:200]}" if lost else ""
        warnings.warn(f"{path}: filled {patched} missing positions of {there.size}{left_out}", stacklevel=3)
    if len(kept) < 3:
        raise ReenactError(f"{path}: expected at least 3 markers without long gaps, got {len(kept)} of {len(names)}")
    return np.array(columns).transpose(2, 0, 1), tuple(kept)


def _rigid_fits(
    rest: Float[np.ndarray, "M 3"], frames: Float[np.ndarray, "T M 3"], weights: Float[np.ndarray, "M"]
) -> tuple[Float[np.ndarray, "T 3 3"], Float[np.ndarray, "T 3"]]:
    """`geometry.rigid_fit` of the rest to every frame at once."""
    shares = (weights / weights.sum())[:, None]
    rest_mean, means = (shares * rest).sum(0), (shares * frames).sum(1)
    products = np.einsum("tmi,mj->tij", frames - means[:, None], shares * (rest - rest_mean))
    left, _, right = np.linalg.svd(products)
    signs = np.ones((len(frames), 3))
    signs[:, 2] = np.sign(np.linalg.det(left @ right))  # no reflection
    rotations = (left * signs[:, None]) @ right
    return rotations, means - rotations @ rest_mean


# ---- files ----

_Raw = tuple[tuple[str, ...], np.ndarray, float, str]
"""Names, positions (T, M, 3) with NaN for what is missing, frame rate, unit."""


def _read_npz(path: Path) -> _Raw:
    arrays = npz.read(path, ("names", "positions", "fps"))
    names = npz.names(path, arrays)
    table.check_names(path, names)
    if "positions" not in arrays:
        raise ReenactError(f"{path}: expected an array positions, got {', '.join(arrays) or 'none that is known'}")
    positions = arrays["positions"]
    if positions.dtype.kind not in "fiu" or positions.ndim != 3 or positions.shape[1:] != (len(names), 3):
        raise ReenactError(
            f"{path}: expected positions (frames, {len(names)}, 3) for {len(names)} names, got {positions.dtype} "
            f"{positions.shape}"
        )
    return names, positions.astype(np.float64), float(npz.floats(path, arrays, "fps", (), np.float64)), "m"


def _read_csv(path: Path) -> _Raw:
    titles, body = table.rows(path)
    columns = {title: index for index, title in enumerate(titles)}
    clocks = [title for title in titles if title.lower() == "time"]
    names = tuple(dict.fromkeys(title.rpartition(".")[0] for title in titles if title not in clocks))
    expected = {f"{name}.{axis}" for name in names for axis in "xyz"}
    if len(clocks) != 1 or not names or expected != set(titles) - set(clocks):
        wrong = sorted(expected.symmetric_difference(set(titles) - set(clocks)))[:3]
        raise ReenactError(
            f"{path}: expected columns time and NAME.x, NAME.y, NAME.z for every marker, got "
            f"{', '.join(titles[:4])[:200]}" + (f"; compare {', '.join(wrong)[:200]}" if wrong else "")
        )
    # An empty cell is a marker that was lost; anything else that is no number is a mistake.
    values = table.numbers(path, titles, [[cell or "0" for cell in row] for row in body])
    empty = np.array([[not cell for cell in row] for row in body], dtype=bool).reshape(values.shape)
    clock = columns[clocks[0]]
    if empty[:, clock].any():
        raise ReenactError(f"{path}: expected a time in every row, row {int(empty[:, clock].argmax()) + 1} has none")
    values[empty] = np.nan
    order = [columns[f"{name}.{axis}"] for name in names for axis in "xyz"]
    positions, fps = steady(str(path), values[:, clock], values[:, order])
    return names, positions.reshape(len(positions), len(names), 3), fps, "m"


def _read_c3d(path: Path) -> _Raw:
    data = disk.read_bytes(path)
    try:
        import c3d
    except ImportError:
        raise ReenactError(f"{path}: reading .c3d needs the package c3d; pip install 'reenact[mocap]'") from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that there are no analog channels
            content = c3d.Reader(io.BytesIO(data))
            labels, rate = [str(label).strip() for label in content.point_labels], float(content.point_rate)
            units = content.get("POINT:UNITS")
            unit = "none" if units is None else units.string_value.strip()
            expected = content.last_frame - content.first_frame + 1
            frames = [points for _, points, _ in content.read_frames()]
        positions = np.array(frames, np.float64).reshape(len(frames), content.point_used, 5)
    except Exception as error:  # The package answers damage with whatever its parsing stumbles over.
        raise ReenactError(f"{path}: expected a .c3d file, it is damaged or something else ({error!r:.200})") from None
    if len(frames) != expected or len(labels) < positions.shape[1]:
        raise ReenactError(
            f"{path}: expected {expected} frames and labels for {positions.shape[1]} points, got {len(frames)} and "
            f"{len(labels)}; is it cut off?"
        )
    positions, residuals = positions[..., :3], positions[..., 3]
    positions[residuals < 0] = np.nan
    tracked = [index for index in range(positions.shape[1]) if labels[index] and not labels[index].startswith("*")]
    names = tuple(labels[index] for index in tracked)
    table.check_names(path, names)
    return names, positions[:, tracked], rate, unit
