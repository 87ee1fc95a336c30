"""Makes tests/fixtures with Blender: one small face, exported as its users would, and the truth about it.

    python -m venv blender; blender/bin/pip install "bpy==4.5.*"
    blender/bin/python tests/make_fixtures_blender.py
    bash tests/make_fixtures_gltf_transform.sh

The face is modelled as many come: centimetres and +Y up inside an armature that turns and scales it, three objects that
share the names of their shapes, seams in its uv, two materials. `truth.npz` holds the same in metres, +Y up, face along
+Z, in Blender's order of objects and vertices. Its shapes go through float32, as Blender stores them.
"""

import math
import shutil
from pathlib import Path

import bpy
import numpy as np

FOLDER = Path(__file__).parent / "fixtures"
NAMES = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight", "mouthSmileLeft", "browInnerUp", "cheekPuffOfBothSides")
FRAMES, FPS = 12, 24
PLACE = (0.0, 0.03, 1.5)  # of the armature in Blender's world, metres


def bump(points, place, radius, push):
    """Offsets that push the points near a place; those beyond twice the radius stay exactly still."""
    distance = np.linalg.norm(points - place, axis=1) / radius
    return np.where(distance < 2, np.exp(-(distance**2)), 0)[:, None] * np.asarray(push)


def face_grid(rows=9, columns=9):
    """A mask of (rows, columns) vertices in centimetres, and its quads."""
    u, v = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(1, -1, rows))
    across, up = 7.5 * np.sin(1.35 * u), 11 * v
    out = 6 * np.cos(1.35 * u) * np.cos(0.9 * v) + 1.5 * np.exp(-((u / 0.15) ** 2) - ((v + 0.1) / 0.3) ** 2)
    points = np.stack([across, up, out], axis=2).reshape(-1, 3)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    quads = np.stack([corner, corner + columns, corner + columns + 1, corner + 1], axis=1)
    # The left and the right half lie apart in the picture, so that the middle line is a seam.
    shift = np.where(corner % columns < (columns - 1) // 2, 0.0, 0.04)
    uv = np.stack([0.46 * (u + 1), 0.5 + 0.48 * v], axis=2).reshape(-1, 2)  # Blender's: (0, 0) bottom left
    return points, quads, uv[quads] + np.stack([shift, 0 * shift], axis=1)[:, None]


def cube(center, size):
    corners = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], dtype=float)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return np.asarray(center) + size * corners, np.array(quads)


def parts():
    """Objects: name -> points in centimetres, quads, uv of their corners, shapes."""
    face, face_quads, face_uv = face_grid()
    left, eye_quads = cube((3.2, 3.0, 3.0), 0.9)
    right, _ = cube((-3.2, 3.0, 3.0), 0.9)
    eyes = np.concatenate([left, right])
    teeth = np.array([(2 * x, -4.5 - y, 4 - 0.5 * x * x) for y in (0, 1) for x in (-1, -0.5, 0, 0.5, 1)])
    teeth_quads = np.array([(i, i + 5, i + 6, i + 1) for i in range(4)])
    jaw_drop = bump(face, (0, -8, 4), 4.5, (0, -2.5, -0.4))
    return {
        "Face": (
            face,
            face_quads,
            face_uv,
            {
                "jawOpen": jaw_drop,
                "eyeBlinkLeft": bump(face, (3.2, 3.2, 4), 1.7, (0, -1.1, 0.2)),
                "eyeBlinkRight": bump(face, (-3.2, 3.2, 4), 1.7, (0, -1.1, 0.2)),
                "mouthSmileLeft": bump(face, (2.5, -5, 5), 1.5, (0.8, 0.7, -0.3)),
                "browInnerUp": bump(face, (0, 6, 5), 3.0, (0, 1.2, 0.3)),
                "cheekPuffOfBothSides": bump(face, (0, -2, 0), 20.0, (0, 0, 1.5)),
            },
        ),
        "Eyes": (
            eyes,
            np.concatenate([eye_quads, eye_quads + 8]),
            (eyes[:, :2] / 20 + 0.5)[np.concatenate([eye_quads, eye_quads + 8])],
            {
                "eyeBlinkRight": np.where(eyes[:, :1] < 0, [0, -0.1, -0.25], 0),
                "eyeBlinkLeft": np.where(eyes[:, :1] > 0, [0, -0.1, -0.25], 0),
            },
        ),
        "Teeth": (
            teeth,
            teeth_quads,
            (teeth[:, :2] / 20 + 0.5)[teeth_quads],
            {"jawOpen": np.where(teeth[:, 1:2] < -5, [0.0, -2.0, -0.3], 0)},
        ),
    }


def weights():
    """(T, K) in whole 1024ths, which every format holds exactly."""
    values = np.random.default_rng(4).integers(0, 1025, (FRAMES, len(NAMES))) / 1024
    values[0] = 0
    return values


def materials():
    skin, lips = bpy.data.materials.new("Skin"), bpy.data.materials.new("Lips")
    across, up = np.meshgrid(np.arange(16), np.arange(16))
    pixels = np.stack([0.55 + 0.02 * across, 0.35 + 0.02 * up, 0.3 + 0.2 * ((across // 4 + up // 4) % 2)], axis=2)
    image = bpy.data.images.new("skin", 16, 16)
    image.pixels = np.concatenate([pixels, np.ones((16, 16, 1))], axis=2).ravel().tolist()
    (FOLDER / "textures").mkdir(exist_ok=True)
    image.filepath_raw, image.file_format = str(FOLDER / "textures" / "skin.png"), "PNG"
    image.save()
    for material in (skin, lips):
        material.use_nodes = True
    shader = skin.node_tree.nodes["Principled BSDF"]
    texture = skin.node_tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    skin.node_tree.links.new(texture.outputs["Color"], shader.inputs["Base Color"])
    lips.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.6, 0.1, 0.12, 1)
    return skin, lips


def add_object(name, armature, skin, lips):
    points, quads, uv, shapes = parts()[name]
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points.tolist(), [], quads.tolist())
    mesh.polygons.foreach_set("use_smooth", [True] * len(quads))
    mesh.uv_layers.new(name="UVMap").data.foreach_set("uv", uv.ravel().tolist())
    mesh.materials.append(skin)
    mesh.materials.append(lips)
    center = points[quads].mean(1)
    mesh.polygons.foreach_set("material_index", on_lips(name, center).astype(int).tolist())
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(thing)
    thing.shape_key_add(name="Basis", from_mix=False)
    for shape, offsets in shapes.items():
        key = thing.shape_key_add(name=shape, from_mix=False)
        key.data.foreach_set("co", (points + offsets).ravel().tolist())
    for bone, share in (("Neck", 0.25), ("Head", 0.75)):
        thing.vertex_groups.new(name=bone).add(range(len(points)), share, "REPLACE")
    thing.parent = armature
    thing.modifiers.new("Armature", "ARMATURE").object = armature
    return thing


def on_lips(name, center):
    return (np.abs(center[:, 0]) < 3) & (np.abs(center[:, 1] + 5.5) < 1.5) & (name == "Face")


def add_armature():
    data = bpy.data.armatures.new("Rig")
    armature = bpy.data.objects.new("Rig", data)
    bpy.context.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    neck, head = data.edit_bones.new("Neck"), data.edit_bones.new("Head")
    neck.head, neck.tail, head.head, head.tail = (0, -20, 0), (0, -10, 0), (0, -10, 0), (0, 5, 0)
    head.parent = neck
    bpy.ops.object.mode_set(mode="OBJECT")
    armature.scale, armature.location, armature.rotation_euler = (0.01,) * 3, PLACE, (math.pi / 2, 0, 0)
    return armature


def animate(things):
    for frame, row in enumerate(weights().tolist()):
        for thing in things:
            for name, weight in zip(NAMES, row):
                block = thing.data.shape_keys.key_blocks.get(name)
                if block is not None:
                    block.value = weight
                    block.keyframe_insert("value", frame=frame + 1)


def write_truth(things):
    neutral, deltas, faces, uv, lips, owner = [], [], [], [], [], []
    for number, thing in enumerate(things):
        _, quads, corner_uv, _ = parts()[thing.name]
        blocks = thing.data.shape_keys.key_blocks
        positions = {}
        for block in blocks:
            flat = np.empty(len(block.data) * 3, np.float32)
            block.data.foreach_get("co", flat)
            positions[block.name] = flat.reshape(-1, 3).astype(float)
        basis = positions["Basis"]
        faces.append(quads + sum(map(len, neutral)))
        # Centimetres, +Y up, turned upright by the armature; in glTF's axes its place is (x, z, -y).
        neutral.append(basis * 0.01 + np.array([PLACE[0], PLACE[2], -PLACE[1]]))
        deltas.append(np.stack([(positions.get(name, basis) - basis) * 0.01 for name in NAMES]))
        uv.append(np.stack([corner_uv[..., 0], 1 - corner_uv[..., 1]], axis=-1))
        lips.append(on_lips(thing.name, parts()[thing.name][0][quads].mean(1)))
        owner += [number] * len(basis)
    np.savez_compressed(
        FOLDER / "truth.npz",
        names=np.array(NAMES),
        objects=np.array([thing.name for thing in things]),
        neutral=np.concatenate(neutral),  # (V, 3) metres, +Y up
        deltas=np.concatenate(deltas, axis=1),  # (K, V, 3)
        faces=np.concatenate(faces),  # (F, 4)
        uv=np.concatenate(uv),  # (F, 4, 2), (0, 0) top left
        lips=np.concatenate(lips),  # (F,) of the second material
        owner=np.array(owner),  # (V,) index into objects
        weights=weights(),  # (T, K)
        fps=np.array(float(FPS)),
    )


def export_obj(things):
    folder = FOLDER / "obj"
    folder.mkdir(exist_ok=True)
    # Without the animation the values of the shapes are ours to set.
    actions = {thing: thing.data.shape_keys.animation_data.action for thing in things}
    for thing in things:
        thing.data.shape_keys.animation_data.action = None
    for shape in ("neutral", *NAMES):
        for thing in things:
            for block in thing.data.shape_keys.key_blocks:
                block.value = float(block.name == shape)
        bpy.ops.wm.obj_export(
            filepath=str(folder / f"{shape}.obj"),
            export_materials=shape == "neutral",
            export_normals=False,
            export_uv=shape == "neutral",
            path_mode="COPY",
        )
    for thing, action in actions.items():
        thing.data.shape_keys.animation_data.action = action


def main():
    shutil.rmtree(FOLDER / "obj", ignore_errors=True)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.frame_start, scene.frame_end = FPS, 1, FRAMES
    armature, (skin, lips) = add_armature(), materials()
    things = [add_object(name, armature, skin, lips) for name in parts()]
    animate(things)
    write_truth(things)
    export = bpy.ops.export_scene.gltf
    export(filepath=str(FOLDER / "blender.glb"))
    export(filepath=str(FOLDER / "blender_sparse.glb"), export_try_sparse_sk=True, export_try_omit_sparse_sk=True,
           export_morph_normal=False, export_animation_mode="ACTIVE_ACTIONS")  # fmt: skip
    export(filepath=str(FOLDER / "blender_draco.glb"), export_draco_mesh_compression_enable=True,
           export_morph_normal=False, export_animation_mode="ACTIVE_ACTIONS")  # fmt: skip
    export(filepath=str(FOLDER / "blender.gltf"), export_format="GLTF_SEPARATE", export_morph_normal=False,
           export_texture_dir="textures", export_try_sparse_sk=False)  # fmt: skip
    # With strips or actions, the exporter's default, it leaves out what is keyed on shapes.
    bpy.ops.export_scene.fbx(filepath=str(FOLDER / "blender.fbx"), add_leaf_bones=False, bake_anim_use_all_bones=False,
                             bake_anim_use_nla_strips=False, bake_anim_use_all_actions=False,
                             bake_anim_force_startend_keying=False)  # fmt: skip
    bpy.ops.wm.usd_export(filepath=str(FOLDER / "blender.usdc"), export_animation=True, relative_paths=True)
    export_obj(things)


if __name__ == "__main__":
    main()
