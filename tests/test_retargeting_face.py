from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from reenact.geometry import edge_graph, mesh_edges, nearest_along
from reenact.retargeting.correspondence import find_correspondence
from reenact.retargeting.face import Face, seen_from_outside
from reenact.rigs.files import load_rig
from reenact.rigs.head import load_head
from reenact.rigs.rig import Rig

ICT = Path(__file__).parents[2] / "shared" / "rigs" / "ict_face.glb"


@pytest.fixture(scope="module", params=["anny:man", "anny:woman", "anny:child", "anny:toon"])
def rig(request) -> Rig:
    return load_rig(request.param)


@pytest.fixture(scope="module")
def man() -> Rig:
    return load_rig("anny:man")


def without_faces(rig: Rig, gone: np.ndarray) -> Rig:
    """The rig with the same vertices, without the faces that touch some of them."""
    kept = ~torch.from_numpy(np.isin(rig.faces.numpy(), gone)).any(1)
    return replace(rig, faces=rig.faces[kept], uv=None, uv_faces=None, texture=None)


def sockets(rig: Rig) -> np.ndarray:
    face = Face.of(rig)
    return face.vertices[face.hollow]


def test_what_is_hollow_are_the_sockets_behind_the_lids(rig):
    painted = load_head().masks["sockets"]  # of the skin, whose vertices come first
    found = np.zeros(len(painted), bool)
    found[sockets(rig)] = True
    assert painted[found].mean() > 0.9
    assert found[painted > 0.99].mean() > 0.9


def test_rims_run_along_the_lids_and_the_lips_and_nowhere_else(rig):
    face = Face.of(rig)
    skin = torch.from_numpy(face.points[face.rim == 1])
    margins = torch.cat([rig.neutral[rig.part(part)] for part in ("lashes", "lips")]).double()
    height = face.height
    assert float(torch.cdist(skin, margins).amin(1).max()) < 0.05 * height
    # Each eye and the mouth has one: their margins lie close to it.
    for part, low, high, near in (("lashes", 0, 1, 0.03), ("lashes", -1, 0, 0.03), ("lips", -0.01, 0.01, 0.1)):
        points = rig.neutral[rig.part(part)].double()
        points = points[(points[:, 0] > low) & (points[:, 0] < high)]
        assert float(torch.cdist(points, skin).amin(1).median()) < near * height


def test_rims_fade_with_the_distance_along_the_skin(man):
    face = Face.of(man)
    start = np.flatnonzero(face.rim == 1)
    distance = nearest_along(edge_graph(face.points, mesh_edges(face.faces)), start)[1]
    np.testing.assert_allclose(face.rim, np.exp(-distance / (0.03 * face.height)), atol=1e-12)


def test_without_hollows_the_rest_is_the_same_skin(man):
    face = Face.of(man)
    open_face = face.without_hollows()
    assert not open_face.hollow.any()
    assert set(open_face.vertices) <= set(face.vertices[~face.hollow])
    rows = np.searchsorted(face.vertices, open_face.vertices)
    np.testing.assert_array_equal(open_face.points, face.points[rows])
    np.testing.assert_array_equal(open_face.deltas, face.deltas[:, rows])
    kept = {tuple(sorted(corners)) for corners in face.vertices[face.faces[~face.hollow[face.faces].any(1)]].tolist()}
    assert {tuple(sorted(corners)) for corners in open_face.vertices[open_face.faces].tolist()} == kept


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_what_is_seen_does_not_hang_on_size_or_place(man, scale):
    middle, height = np.array([0.0, 0.0, 0.1]), 0.15
    seen = seen_from_outside(man, middle, height)
    moved = replace(man, neutral=(man.neutral + torch.tensor([0.3, -0.2, 0.1])) * scale)
    again = seen_from_outside(moved, (middle + np.array([0.3, -0.2, 0.1])) * scale, height * scale)
    assert (seen == again).mean() > 0.995
    assert 0.3 < seen.mean() < 0.9


def test_eyeballs_hide_the_sockets(man):
    face = Face.of(man)
    hollow = face.vertices[face.hollow]
    middle = np.median(face.points, axis=0)
    blind = without_faces(man, man.part("eyes").numpy())
    assert seen_from_outside(man, middle, face.height)[hollow].mean() < 0.02
    assert seen_from_outside(blind, middle, face.height)[hollow].mean() > 0.1


def test_a_head_in_a_box_has_no_hollows(man):
    low, high = man.neutral.amin(0) - 0.01, man.neutral.amax(0) + 0.01
    box = trimesh.creation.box(bounds=np.stack([low, high]))
    walls = torch.from_numpy(box.vertices).float()
    hidden = replace(
        man,
        neutral=torch.cat([man.neutral, walls]),
        deltas=torch.cat([man.deltas, torch.zeros(len(man.names), len(walls), 3)], 1),
        faces=torch.cat([man.faces, torch.from_numpy(box.faces) + len(man.neutral)]),
        parts=torch.cat([man.parts, torch.zeros(len(walls)).to(man.parts)]),
        colors=None,
        uv=None,
        uv_faces=None,
        texture=None,
    )
    face = Face.of(hidden)
    assert not face.hollow.any()
    np.testing.assert_array_equal(face.vertices, Face.of(man).vertices)


def test_lids_find_their_partners_where_only_one_head_has_sockets(man):
    woman = load_rig("anny:woman")
    shell = without_faces(woman, sockets(woman))
    assert not Face.of(shell).hollow.any()
    pairs = find_correspondence(man, shell, None)
    vertices = pairs.source.corners[:, 0]
    assert not set(sockets(man)) & set(vertices.tolist())
    blink = sum(man.deltas[man.names.index(f"eyeBlink{side}")].norm(dim=1) for side in ("Left", "Right"))
    lids = (blink > 0.2 * blink.max())[vertices]
    missed = (pairs.target.of(woman.neutral) - woman.neutral[vertices]).norm(dim=1)[lids] / Face.of(woman).height
    assert int(lids.sum()) > 100
    # Measured 0.003 and 0.009; dragged along by the sockets, 0.018 and not 0.009.
    assert float(missed.median()) < 0.006
    assert float(missed.quantile(0.95)) < 0.013


def test_a_head_of_another_maker_ends_at_its_lids():
    if not ICT.exists():
        pytest.skip("rigs/ict_face.glb is test data that only some machines have")
    assert not Face.of(load_rig(str(ICT))).hollow.any()
