"""What was found, as lines and tables for the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

if TYPE_CHECKING:
    from reenact.inspection import Inspection


def of_step(older: int | None) -> str:
    """Whose networks it was, where they are not the newest."""
    return "" if older is None else f", of step {older:,}"


def inspection_lines(facts: Inspection) -> list[Any]:
    """What was found in a rig, for the terminal."""
    contents = facts.contents
    width, height, depth = (100 * each for each in facts.size)
    lines: list[Any] = [
        f"{facts.name}: {contents.format}",
        f"{facts.vertices} vertices, {facts.faces} faces, {len(facts.shapes)} blendshapes",
        f"{width:.1f} cm wide, {height:.1f} cm tall, {depth:.1f} cm deep"
        + (f"; {100 * facts.face:.1f} cm from eyes to mouth" if facts.face is not None else ""),
    ]
    lines += [f"parts: {', '.join(facts.parts)}"] if facts.parts else []
    lines += [f"animation: {text}" for text in contents.animations]
    lines += [f"texture: {text}" for text in contents.textures]
    lines += [f"converted: {text}" for text in contents.converted]
    meshes = Table(title="Meshes", title_justify="left")
    for column in ("mesh", "vertices", "faces", "shapes", "in the rig"):
        meshes.add_column(column, justify="left" if column in ("mesh", "in the rig") else "right")
    for mesh in contents.meshes:
        faces = str(mesh.faces) if mesh.faces else "-"
        used = f"{'yes' if mesh.used else 'no'}, {mesh.reason}"
        meshes.add_row(mesh.name, str(mesh.vertices), faces, str(mesh.shapes), used)
    shapes = Table(
        title="Shapes",
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
        caption="strength: largest offset, 1 is the distance from eyes to mouth; moved: share of the vertices",
        caption_justify="left",
    )
    shapes.add_column("shape", no_wrap=True)
    shapes.add_column("ARKit", no_wrap=True)
    for column in ("strength", "moved", "region", "side"):
        shapes.add_column(column, justify="right" if column in ("strength", "moved") else "left")
    for shape in facts.shapes:
        known = "same" if shape.arkit == shape.name else shape.arkit or "-"
        numbers = (f"{shape.strength:.3f}", f"{100 * shape.moved:.0f} %")
        shapes.add_row(shape.name, known, *numbers, shape.region, shape.side)
    lines += ["", meshes, shapes]
    wrong = [*facts.problems, *(f"{shape.name} {text}" for shape in facts.shapes for text in shape.problems)]
    lines += ["", f"Looks wrong ({len(wrong)}):" if wrong else "Nothing looks wrong"]
    return [*lines, *(f"  {text}" for text in wrong)]


def evaluation_tables(numbers: dict[str, Any]) -> list[Table]:
    """What one evaluation found, for the terminal."""
    columns = {"this run": numbers, "direct": numbers["direct"]}
    columns |= {"pairs": numbers["paired"]} if numbers["paired"] else {}
    columns |= {name.replace("_", " "): row for name, row in numbers["baselines"].items()}
    run = f"{numbers['run']}{of_step(numbers.get('checkpoint'))}"
    title = f"{run}: {numbers['source']} -> {numbers['target']}, {numbers['frames']} unseen frames"
    caption = "direct: without ReenactNet" + "; pairs: of shapes, without any network" * bool(numbers["paired"])
    if numbers.get("exact"):
        caption += f"\ncyclic.skill of the truth itself: {_number(numbers['exact']['cyclic']['skill'])}"
    look: dict[str, Any] = {"title_justify": "left", "box": SIMPLE_HEAD, "pad_edge": False}  # 80 columns hold them
    compared = Table(title=title, caption=caption, caption_justify="left", **look)
    compared.add_column("", no_wrap=True)
    for name in columns:
        compared.add_column(name, justify="right")
    measures = {"truth": ("ver", "wmae", "correlation", "gain"), "cyclic": ("mae", "ssim", "mae_masked", "skill")}
    for group, names in measures.items():
        for name in names:
            values = [(row[group] or {}).get(name) for row in columns.values()]
            compared.add_row(f"{group}.{name}", *map(_number, values))
    alone = Table(title="BPNet alone; speed", **look)
    alone.add_column("", no_wrap=True)
    alone.add_column("value", justify="right")
    for group, names in {
        "bpnet": ("wmae", "ver", "psnr", "ssim"),
        "speed": ("fps", "latency_ms_p50", "latency_ms_p99"),
    }.items():
        for name in names:
            alone.add_row(f"{group}.{name}", _number(numbers[group][name]))
    if not numbers["methods"]:
        return [compared, alone]
    others = Table(title="Geometric methods, the same frames", **look)
    others.add_column("", no_wrap=True)
    for name in measures["truth"]:
        others.add_column(f"truth.{name}", justify="right")
    for method, row in numbers["methods"].items():
        others.add_row(method, *(_number((row["truth"] or {}).get(name)) for name in measures["truth"]))
    return [compared, others, alone]


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if abs(value) < 10 else f"{value:.1f}"
