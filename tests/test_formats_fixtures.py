"""Files that Blender and glTF Transform wrote mean what they mean there: see tests/fixtures/README.md."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from reenact.rigs.clip import Clip
from reenact.rigs.files import load_rig, read_clip
from reenact.rigs.rig import Rig

FOLDER = Path(__file__).parent / "fixtures"
TRUTH = np.load(FOLDER / "truth.npz")
NAMES = tuple(TRUTH["names"].tolist())

FLOAT = 1e-6  # metres: float32 centimetres 1.5 m above the ground
DRACO = 0.23 / 2**14  # 14 bits over the tallest mesh
QUANTISED = (
    0.83 / 2**14 * 1.1
)  # 14 bits as glTF Transform counts: from the mesh to the armature's origin and as far beyond

FILES = {  # file: package that it needs, error of positions, error of offsets
    "blender.glb": (None, FLOAT, FLOAT),
    "blender_sparse.glb": (None, FLOAT, FLOAT),
    "blender.gltf": (None, FLOAT, FLOAT),
    "blender_draco.glb": ("DracoPy", DRACO, FLOAT),
    "transform_draco.glb": ("DracoPy", DRACO, FLOAT),
    "transform_meshopt.glb": ("meshopt", QUANTISED, QUANTISED),
    "transform_quantize.glb": (None, QUANTISED, QUANTISED),
    "transform_sparse.glb": (None, FLOAT, FLOAT),
    "transform_webp.glb": (None, FLOAT, FLOAT),
    "blender.fbx": ("ufbx", FLOAT, FLOAT),
    "blender.usdc": ("pxr", FLOAT, FLOAT),
    "obj": (None, FLOAT, 2e-6),  # six decimals, twice
}
MOVING = [file for file in FILES if file != "obj"]


def rig_of(file: str) -> Rig:
    """The rig in a fixture; skips where the package for it is missing."""
    path, package = FOLDER / file, FILES[file][0]
    if package:
        pytest.importorskip(package)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_rig(str(path))


def clip_of(file: str) -> Clip:
    path, package = FOLDER / file, FILES[file][0]
    if package:
        pytest.importorskip(package)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return read_clip(path)


def places(rig: Rig) -> np.ndarray:
    """The vertex of the truth that lies next to each vertex of the rig; no two of them are within 4 mm."""
    return cKDTree(TRUTH["neutral"]).query(rig.neutral.numpy())[1]


@pytest.mark.parametrize("file", FILES)
def test_vertices_lie_where_they_lay(file):
    rig = rig_of(file)
    place = places(rig)
    np.testing.assert_allclose(rig.neutral, TRUTH["neutral"][place], rtol=0, atol=FILES[file][1])
    assert set(place) == set(range(len(TRUTH["neutral"])))
    # Ten vertices are on the edge of the lips, which may stay apart as another part or colour; all else is welded.
    assert 107 <= len(rig.neutral) <= 117


@pytest.mark.parametrize("file", FILES)
def test_shapes_have_their_names_and_move_what_they_moved(file):
    rig = rig_of(file)
    assert sorted(rig.names) == sorted(NAMES)
    place = places(rig)
    for index, name in enumerate(NAMES):
        offsets = rig.deltas[rig.names.index(name)]
        np.testing.assert_allclose(offsets, TRUTH["deltas"][index][place], rtol=0, atol=FILES[file][2], err_msg=name)


@pytest.mark.parametrize("file", FILES)
def test_triangles_are_halves_of_the_quads_and_face_the_same_way(file):
    rig = rig_of(file)
    triangles = places(rig)[rig.faces.numpy()]
    halves = {
        tuple(np.roll(np.delete(quad, corner), turn))
        for quad in TRUTH["faces"]
        for corner in range(4)
        for turn in range(3)
    }
    assert len(triangles) == 2 * len(TRUTH["faces"])
    assert {tuple(triangle) for triangle in triangles} <= halves
    assert len({frozenset(triangle.tolist()) for triangle in triangles}) == len(triangles)


@pytest.mark.parametrize("file", FILES)
def test_every_triangle_has_the_colour_of_its_place_in_the_picture(file):
    rig = rig_of(file)
    triangles = places(rig)[rig.faces.numpy()]
    quads = {
        frozenset(np.delete(quad, corner).tolist()): index
        for index, quad in enumerate(TRUTH["faces"])
        for corner in range(4)
    }
    colors = np.ones((len(triangles), 3))
    if rig.colors is not None:
        colors = rig.colors.numpy()[rig.faces.numpy()].mean(1)
    if rig.texture is not None:
        uv = rig.uv[rig.faces if rig.uv_faces is None else rig.uv_faces].mean(1).numpy()
        height, width, _ = rig.texture.shape
        column, row = (uv * [width, height]).astype(int).T
        colors = colors * rig.texture.numpy()[row.clip(0, height - 1), column.clip(0, width - 1)]
    for triangle, color in zip(triangles, colors):
        quad = quads[frozenset(triangle.tolist())]
        if TRUTH["lips"][quad]:
            np.testing.assert_allclose(color, [0.797, 0.349, 0.381], rtol=0, atol=0.02, err_msg=f"quad {quad}")
            continue
        corners = [np.flatnonzero(TRUTH["faces"][quad] == vertex)[0] for vertex in triangle]
        u, v = 16 * TRUTH["uv"][quad][corners].mean(0)
        # Of 16 x 16 pixels, red rises by 0.02 with each to the right and green with each to the top.
        expected = [0.54 + 0.02 * u, 0.34 + 0.02 * (16 - v)]
        within = 0.08 if "webp" in file else 0.04  # two pixels; WebP blurs
        np.testing.assert_allclose(color[:2], expected, rtol=0, atol=within, err_msg=f"quad {quad}")


@pytest.mark.parametrize("file", MOVING)
def test_animation_has_the_weights_of_each_frame(file):
    clip = clip_of(file)
    assert sorted(clip.names) == sorted(NAMES)
    assert clip.fps == TRUTH["fps"]
    weights = clip.weights[:, [clip.names.index(name) for name in NAMES]]
    np.testing.assert_allclose(weights, TRUTH["weights"], rtol=0, atol=1e-6)  # whole 1024ths; FBX: as percent


@pytest.mark.parametrize("file", MOVING)
def test_rig_and_animation_of_a_file_make_its_frames(file):
    rig, clip = rig_of(file), clip_of(file)
    order = [clip.names.index(name) for name in rig.names]
    frames = rig.vertices(clip.weights[:, order])
    truth = TRUTH["neutral"] + np.einsum("tk,kvc->tvc", TRUTH["weights"], TRUTH["deltas"])
    _, positions, offsets = FILES[file]
    np.testing.assert_allclose(frames, truth[:, places(rig)], rtol=0, atol=positions + len(NAMES) * offsets)
