"""Which places of two rigs belong together: given, by shared landmarks, or found."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from reenact.errors import ReenactError
from reenact.geometry import farthest_points
from reenact.retargeting import registration
from reenact.retargeting.face import STILL
from reenact.retargeting.thinning import thinned
from reenact.rigs.formats import disk, npz, table
from reenact.rigs.rig import Rig

MOST_VERTICES = 30_000
"""Of surfaces that are registered; larger ones are thinned. Registration of 100,000 takes more than a quarter of an
hour, and a face that moves is told well enough by a tenth."""
MARKERS = 99
"""Pairs that are sampled unless said otherwise, as many as the published captures have markers."""


@dataclass(frozen=True)
class Places:
    """Points on the surface of a rig: each a weighted mean of three vertices."""

    corners: Int[Tensor, "N 3"]
    """Vertices of the face that a point lies on."""
    shares: Float[Tensor, "N 3"]
    """Barycentric coordinates, summing to 1."""

    @classmethod
    def at(cls, vertices: Int[Tensor, "N"]) -> Places:
        """The places of whole vertices."""
        corners = vertices[:, None].expand(-1, 3).contiguous()
        return cls(corners, torch.tensor([1.0, 0.0, 0.0]).expand(len(vertices), 3).contiguous())

    def __len__(self) -> int:
        return len(self.corners)

    def of(self, vertices: Float[Tensor, "*batch V 3"]) -> Float[Tensor, "*batch N 3"]:
        """Positions, or offsets, at the places."""
        shares = self.shares.to(vertices.dtype)
        return torch.einsum("...nci,nc->...ni", vertices[..., self.corners, :], shares)

    def __getitem__(self, chosen: Int[Tensor, "M"]) -> Places:
        return Places(self.corners[chosen], self.shares[chosen])

    def among(self, vertices: Int[Tensor, "N"]) -> Places:
        """The same places, where the rig's vertices are these of a larger rig."""
        return Places(vertices[self.corners], self.shares)


@dataclass(frozen=True)
class Correspondence:
    """N pairs of places, the n-th of the source with the n-th of the target.

    Raises:
        ReenactError: The sizes disagree, or there are fewer than four pairs.
    """

    source: Places
    target: Places
    confidence: Float[Tensor, "N"]
    """How sure each pair is, in [0, 1]; 1 where a person or the topology gave it."""

    def __post_init__(self) -> None:
        if not len(self.source) == len(self.target) == len(self.confidence):
            raise ReenactError(
                f"correspondence: expected as many source as target places and confidences, got {len(self.source)}, "
                f"{len(self.target)} and {len(self.confidence)}"
            )
        if len(self.source) < 4:
            raise ReenactError(f"correspondence: expected at least 4 pairs, got {len(self.source)}")

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, chosen: Int[Tensor, "M"]) -> Correspondence:
        return Correspondence(self.source[chosen], self.target[chosen], self.confidence[chosen])

    def sample(self, rig: Rig, count: int = MARKERS) -> Correspondence:
        """Pairs spread over the face that the source's shapes move, denser where more of them move it.

        That is around mouth and eyes, as markers are set for capture. Each is the surest of the pairs around its place.
        Ours.

        Args:
            rig: The source.
            count: Pairs; as many as there are that move, where that is fewer.

        Raises:
            ReenactError: The shapes move fewer than four of the pairs.
        """
        reach = rig.deltas.norm(dim=-1).amax(1)  # (K,)
        motion = self.source.of(rig.deltas).norm(dim=-1)  # (K, N)
        live = reach > STILL * reach.max()
        strength = (motion[live] / reach[live, None]).square().sum(0)  # the more shapes, and the nearer to their middle
        weights = (strength.sqrt() * self.confidence).sqrt()
        weights = torch.where(weights > 1e-2 * weights.max(), weights, 0)
        moving = int((weights > 0).sum())
        if moving < 4:
            raise ReenactError(f"{rig.name}: expected at least 4 pairs that its shapes move, got {moving}")
        points = self.source.of(rig.neutral)
        spread = farthest_points(points, min(count, moving), weights)
        eligible = weights.nonzero().flatten()
        cell = torch.cdist(points[eligible], points[spread]).argmin(1)
        order = self.confidence[eligible].argsort(stable=True)
        surest = spread.numpy().copy()
        surest[cell[order].numpy()] = eligible[order].numpy()  # NumPy keeps what is written last; PyTorch any of them
        return self[torch.from_numpy(surest)]

    def reversed(self) -> Correspondence:
        """The same pairs from the target to the source."""
        return Correspondence(self.target, self.source, self.confidence)

    def then(self, other: Correspondence) -> Correspondence:
        """From this source by way of a third rig to the other's target: pairs that meet there at one vertex. Ours.

        Both must lie on whole vertices of the third rig, this one with its targets, as `reversed` makes of what
        `find_correspondence` finds from it. A pair is right where both are: their confidences multiply.

        Raises:
            ReenactError: They meet at fewer than four vertices.
        """
        middles = []
        for places in (self.target, other.source):
            whole = places.shares.amax(1) == 1
            middles.append(torch.where(whole, places.corners.gather(1, places.shares.argmax(1, True))[:, 0], -1))
        rows = {vertex: row for row, vertex in enumerate(middles[1].tolist()) if vertex >= 0}
        met = [(row, rows[vertex]) for row, vertex in enumerate(middles[0].tolist()) if vertex in rows]
        if len(met) < 4:
            raise ReenactError(f"correspondence: expected at least 4 pairs that meet on a third rig, got {len(met)}")
        here, there = torch.tensor(met).T
        return Correspondence(self.source[here], other.target[there], self.confidence[here] * other.confidence[there])

    @classmethod
    def identity(cls, source: Rig, target: Rig) -> Correspondence:
        """Each vertex with the vertex of the same number, for rigs that share their topology.

        Raises:
            ReenactError: The rigs differ in their number of vertices.
        """
        if len(source.neutral) != len(target.neutral):
            raise ReenactError(
                f"correspondence: expected rigs with as many vertices, got {len(source.neutral)} of {source.name} and "
                f"{len(target.neutral)} of {target.name}; let the correspondence be found"
            )
        places = Places.at(torch.arange(len(source.neutral)))
        return cls(places, places, torch.ones(len(places)))


def find_correspondence(
    source: Rig, target: Rig, count: int | None = MARKERS, use_names: bool = True
) -> Correspondence:
    """Pairs found from the shape of both faces and from how their shapes move them; see `registration`.

    Args:
        source: Whose vertices are paired.
        target: On whose surface their partners lie; any topology.
        count: Pairs, see `Correspondence.sample`; None for all vertices of the face that the source's shapes move, of
            rigs of more than `MOST_VERTICES` those that `thinned` keeps.
        use_names: Whether names may tell which shapes of both rigs are the same. Where they do not, motion does.

    Returns:
        Pairs whose confidence is the chance that they are right to 1 % of the height of the face, as measured on heads
        whose pairs are known.

    Raises:
        ReenactError: A rig does not move, no four shapes of both move the face alike, or a surface is so odd that the
            arithmetic breaks down.
    """
    (ours, our_vertices), (theirs, their_vertices) = (thinned(rig, MOST_VERTICES) for rig in (source, target))
    try:
        with np.errstate(all="ignore"):  # the sentence below says it better
            found = _correspondence(registration.register(ours, theirs, use_names))
    except (RuntimeError, np.linalg.LinAlgError) as error:  # singular systems of SciPy, PyTorch and NumPy
        raise ReenactError(
            f"{source.name} and {target.name}: their surfaces cannot be registered ({error}); `reenact inspect` tells "
            "what is odd about a rig (is it inside out?), or give pairs of places in a file of correspondences"
        ) from error
    dense = Correspondence(found.source.among(our_vertices), found.target.among(their_vertices), found.confidence)
    return dense if count is None else dense.sample(source, count)


def from_landmarks(
    source: Rig, target: Rig, source_vertices: Int[Tensor, "M"], target_vertices: Int[Tensor, "M"]
) -> Correspondence:
    """A pair for every vertex of the source's moving face, from a handful of given ones.

    The source is bent as little as it can be to meet the landmarks, then onto the target's surface.

    Raises:
        ReenactError: Fewer than four landmarks, one that is no vertex, or one that does not lie on the skin.
    """
    for rig, vertices in ((source, source_vertices), (target, target_vertices)):
        if len(vertices) < 4 or len(vertices) != len(source_vertices):
            raise ReenactError(
                f"landmarks: expected at least 4 and as many of both rigs, got {len(source_vertices)} and "
                f"{len(target_vertices)}"
            )
        _check_vertices("landmarks", rig, vertices.cpu().numpy())
    found = registration.complete(source, target, source_vertices.cpu().numpy(), target_vertices.cpu().numpy())
    return _correspondence(found)


def _correspondence(found: registration.Registration) -> Correspondence:
    places = Places(torch.from_numpy(found.corners), torch.from_numpy(found.shares).float())
    confidence = registration.confidence(found.error)
    return Correspondence(Places.at(torch.from_numpy(found.vertices)), places, torch.from_numpy(confidence).float())


def load_correspondence(path: str | Path, source: Rig, target: Rig) -> Correspondence:
    """The pairs in a file.

    A .csv has columns `source` and `target` with numbers of vertices, and may have `confidence`. A .npz has the same as
    arrays, or what `save_correspondence` writes.

    Raises:
        ReenactError: No such file, another suffix, something else in it, or a vertex that a rig does not have.
    """
    path = Path(path)
    if path.suffix.lower() == ".csv":
        titles, body = table.rows(path)
        if set(titles) - {"confidence"} != {"source", "target"}:
            raise ReenactError(
                f"{path}: expected columns source, target and maybe confidence, got {', '.join(titles)[:200]}"
            )
        columns = dict(zip(titles, table.numbers(path, titles, body).T))
    elif path.suffix.lower() == ".npz":
        keys = ("source", "target", "source_shares", "target_shares", "confidence")
        arrays = npz.read(path, keys)
        columns = {key: npz.floats(path, arrays, key, arrays[key].shape, np.float64) for key in arrays}
        for key in ("source", "target"):
            if key not in columns:
                raise ReenactError(f"{path}: expected an array {key}, got {', '.join(columns) or 'none that is known'}")
    else:
        raise ReenactError(f"{path}: a correspondence is read from .csv or .npz, got {path.suffix or 'no suffix'}")
    places = [_places(path, columns, key, rig) for key, rig in (("source", source), ("target", target))]
    confidence = columns.get("confidence", np.ones(len(places[0])))
    if confidence.shape != (len(places[0]),) or not ((confidence >= 0) & (confidence <= 1)).all():
        raise ReenactError(f"{path}: expected one confidence in [0, 1] a pair, got {confidence.shape} or others")
    try:
        return Correspondence(*places, torch.from_numpy(confidence).float())
    except ReenactError as error:
        raise ReenactError(f"{path}: {error}") from None


def save_correspondence(correspondence: Correspondence, path: str | Path) -> None:
    """Writes the pairs; as .csv only where every place is a vertex.

    Raises:
        ReenactError: Another suffix, a place between vertices in a .csv, or the file cannot be written.
    """
    path = Path(path)
    pair = {"source": correspondence.source, "target": correspondence.target}
    if path.suffix.lower() == ".npz":
        arrays = {"confidence": correspondence.confidence.numpy()}
        for key, places in pair.items():
            arrays |= {key: places.corners.numpy(), f"{key}_shares": places.shares.numpy()}
        npz.write(path, **arrays)
    elif path.suffix.lower() == ".csv":
        if any(bool((places.shares.amax(1) < 1).any()) for places in pair.values()):
            raise ReenactError(f"{path}: expected places on vertices in a .csv, got some between them; write a .npz")
        vertices = [
            places.corners.gather(1, places.shares.argmax(1, keepdim=True)).flatten() for places in pair.values()
        ]
        text = io.StringIO(newline="")
        text.write("source,target,confidence\n")
        for row in zip(*(column.tolist() for column in (*vertices, correspondence.confidence))):
            text.write(",".join(map(repr, row)) + "\n")
        disk.write_bytes(path, text.getvalue().encode())
    else:
        raise ReenactError(f"{path}: a correspondence is written as .csv or .npz, got {path.suffix or 'no suffix'}")


def _places(path: Path, columns: dict[str, np.ndarray], key: str, rig: Rig) -> Places:
    vertices = columns[key]
    if not (vertices == np.round(vertices)).all() or np.abs(vertices).max(initial=0) > 2**31:
        raise ReenactError(f"{path}: expected whole numbers of vertices in {key}")
    vertices = vertices.astype(np.int64)
    _check_vertices(str(path), rig, vertices)
    if vertices.ndim == 1:
        return Places.at(torch.from_numpy(vertices))
    shares = columns.get(f"{key}_shares", np.zeros(0))
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or shares.shape != vertices.shape:
        raise ReenactError(
            f"{path}: expected {key} (pairs,), or (pairs, 3) with {key}_shares, got {vertices.shape} and {shares.shape}"
        )
    if not ((shares >= -1e-4).all() and (np.abs(shares.sum(1) - 1) < 1e-3).all()):
        raise ReenactError(f"{path}: expected {key}_shares that are not negative and sum to 1")
    return Places(torch.from_numpy(vertices), torch.from_numpy(shares).float())


def _check_vertices(where: str, rig: Rig, vertices: Int[np.ndarray, "*shape"]) -> None:
    count = len(rig.neutral)
    if vertices.size and not (vertices.min() >= 0 and vertices.max() < count):
        wrong = int(vertices[(vertices < 0) | (vertices >= count)][0])
        raise ReenactError(f"{where}: expected vertices of {rig.name} in 0..{count - 1}, got {wrong}")
