"""A rig driven by markers tracked on an actor's face, without a rig of the actor.

Ribera et al. 2017, "Facial Retargeting with Automatic Range of Motion Alignment", doi:10.1145/3072959.3073674, in the
setting that it was made for: sparse markers, their places on the rig, and a take that covers the actor's range of
motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Int
from torch import Tensor

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Places
from reenact.retargeting.geometric_prior import bending
from reenact.retargeting.manifold_alignment import frame_solver, personalise
from reenact.retargeting.marker_mesh import marker_mesh, surface_distances
from reenact.retargeting.markers import Markers
from reenact.retargeting.rbf import ThinPlate
from reenact.rigs.clip import Clip
from reenact.rigs.formats import table
from reenact.rigs.rig import Rig


def drive(
    rig: Rig,
    take: Markers,
    names: Sequence[str],
    vertices: Int[Tensor, "M"],
    preset: str = "quantile",
    training: Markers | None = None,
) -> Clip:
    """The rig's weights for a marker take: head motion removed, size and range of motion aligned.

    Args:
        rig: What is driven.
        take: What was captured.
        names: Markers to use, those on the skull among them if there are any.
        vertices: Where on the rig each of them lies.
        preset: Of `manifold_alignment.PRESETS`.
        training: A take of the same actor and markers that covers the whole range of motion; `take` itself where None.

    Raises:
        ReenactError: Fewer than four markers, a name that the take lacks, or a vertex that the rig lacks.
    """
    if len(names) != len(vertices) or len(names) < 4:
        raise ReenactError(f"markers: expected at least 4 with a vertex each, got {len(names)} and {len(vertices)}")
    if int(vertices.min()) < 0 or int(vertices.max()) >= len(rig.neutral):
        raise ReenactError(f"markers: expected vertices of {rig.name} in 0..{len(rig.neutral) - 1}")
    places = Places.at(vertices)
    rest = places.of(rig.neutral)
    moved, shown = (each.chosen(names).stabilised().aligned(rest, scaled=True) for each in (take, training or take))
    rest, shapes = rest.double(), places.of(rig.deltas).double()  # s_0, ds
    plate = ThinPlate(rest, moved.neutral.double())
    guess = plate(rest + shapes) - plate(rest)  # dg
    laplacian = None
    if preset in ("paper", "robust"):
        laplacian = marker_mesh(rest, surface_distances(rig, places)).laplacian(rest)
    personal = personalise(shapes, guess, (shown.positions - shown.neutral).double(), laplacian, preset)
    solver = frame_solver(personal, preset, bending(rig) if preset == "paper" else None)
    unit = 100.0 if preset == "paper" else 1.0  # the paper's constants are for centimetres
    weights = solver((moved.positions - moved.neutral).double() * unit)
    return Clip(rig.names, weights.float(), take.fps)


def load_places(path: str | Path, rig: Rig) -> tuple[tuple[str, ...], Int[Tensor, "M"]]:
    """Names of markers and the rig's vertices that they lie on, from a .csv with columns marker and vertex.

    Raises:
        ReenactError: No such file, other columns, a name twice, or a vertex that the rig lacks.
    """
    path = Path(path)
    titles, body = table.rows(path)
    if sorted(titles) != ["marker", "vertex"]:
        raise ReenactError(f"{path}: expected columns marker and vertex, got {', '.join(titles)[:200]}")
    names = [row[titles.index("marker")] for row in body]
    table.check_names(path, names)
    numbers = table.numbers(path, ["vertex"], [[row[titles.index("vertex")]] for row in body])[:, 0]
    wrong = (numbers != numbers.round()) | (numbers < 0) | (numbers >= len(rig.neutral))
    if wrong.any():
        row = int(wrong.argmax())
        raise ReenactError(
            f"{path}: expected a vertex of {rig.name} below {len(rig.neutral)} in row {row + 1}, got {numbers[row]:g}"
        )
    return tuple(names), torch.from_numpy(numbers).long()
