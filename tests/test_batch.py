"""A batch does what it can, says what it could not, and goes on where it stopped."""

import csv
import json
import os
import subprocess
import sys

import pytest
import torch

from reenact import batch
from reenact.batch import Item, read_manifest, run_batch
from reenact.cli import main
from reenact.errors import ReenactError
from reenact.inference import ImageRetargeter
from reenact.rigs.files import load_clip


def _manifest(folder, rows):
    path = folder / "manifest.json"
    path.write_text(json.dumps(rows))
    return path


@pytest.fixture
def rows(toy_run, toy_config, tmp_path):
    """Two that work, by networks and by a method, and two that cannot."""
    return [
        {"run": f"{toy_run.folder}", "clip": "synthetic:3:1", "out": f"{tmp_path / 'a.csv'}", "fps": 20},
        {"run": f"{toy_run.folder}", "clip": "none.csv", "out": f"{tmp_path / 'b.csv'}"},
        {"run": f"{toy_run.folder}", "from": "cat", "clip": "synthetic:3:1", "out": f"{tmp_path / 'c.csv'}"},
        {
            "method": "copy",
            "source": toy_config.source,
            "target": toy_config.target,
            "clip": "synthetic:4:1",
            "out": f"{tmp_path / 'd.csv'}",
        },
    ]


def test_what_fails_does_not_stop_the_rest_and_both_are_in_the_table(rows, toy_run, tmp_path, capsys):
    assert main(["batch", f"{_manifest(tmp_path, rows)}"]) == 3
    assert "manifest-results.csv: 2 of 4 ok, 2 failed" in capsys.readouterr().out
    with open(tmp_path / "manifest-results.csv", newline="") as file:
        made = list(csv.DictReader(file))
    assert [row["state"] for row in made] == ["ok", "failed", "failed", "ok"]
    assert [row["item"] for row in made] == ["1", "2", "3", "4"]
    assert made[0]["frames"] == "20"
    assert "none.csv" in made[1]["error"]
    assert "expected a rig of the run, ball, egg, got cat" in made[2]["error"]
    retargeter = ImageRetargeter.load(toy_run.folder)
    alone = tmp_path / "alone.csv"
    command = ["infer", f"{toy_run.folder}", "synthetic:3:1", "--fps", "20", "--out", f"{alone}"]
    assert main(command) == 0
    both = [load_clip(f"{path}", retargeter.target).weights for path in (alone, tmp_path / "a.csv")]
    assert torch.equal(*both)


def test_what_is_done_is_not_made_again_and_what_failed_is_tried_again(rows, tmp_path, monkeypatch):
    manifest, results = _manifest(tmp_path, rows), tmp_path / "results.csv"
    asked = []
    move = batch._move
    monkeypatch.setattr(batch, "_move", lambda item, *others: asked.append(item.out[-5:]) or move(item, *others))
    assert run_batch(manifest, results)[0] == 2
    with open(results, "a") as file:
        file.write('5,"torn by a power c')
    (tmp_path / "d.csv").unlink()
    asked.clear()
    rows[1]["clip"] = "synthetic:5:1"
    failed, table = run_batch(_manifest(tmp_path, rows), results)
    assert asked == ["b.csv", "c.csv", "d.csv"]
    assert failed == 1
    assert [row["state"] for row in table] == ["ok", "ok", "failed", "ok"]
    assert len(results.read_text().splitlines()) == 5


def test_a_fault_of_ours_is_a_row_too(rows, tmp_path, monkeypatch, capsys):
    def broken(*_):
        raise ZeroDivisionError("x / 0")

    monkeypatch.setattr(batch, "_move", broken)
    failed, table = run_batch(_manifest(tmp_path, rows[:1]), tmp_path / "results.csv")
    assert failed == 1
    assert table[0]["error"] == "a fault in Reenact, please report it: ZeroDivisionError: x / 0"
    assert "Traceback" in capsys.readouterr().err


def test_two_processes_share_the_items(rows, tmp_path):
    manifest = _manifest(tmp_path, rows)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    done = subprocess.run(
        [*command, "-m", "reenact.cli", "batch", manifest],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])},
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.returncode != 0  # two items cannot work
    with open(tmp_path / "manifest-results.csv", newline="") as file:
        assert [row["state"] for row in csv.DictReader(file)] == ["ok", "failed", "failed", "ok"]
    assert (tmp_path / "a.csv").is_file()
    assert (tmp_path / "d.csv").is_file()


def test_manifests_of_all_kinds_say_the_same(tmp_path):
    (tmp_path / "m.csv").write_text("run,clip,out,from,to,fps\nr,c.csv,o.csv,a,b,24\nr,d.csv,p.csv,,,\n")
    (tmp_path / "m.json").write_text(
        '[{"run": "r", "clip": "c.csv", "out": "o.csv", "from": "a", "to": "b", "fps": 24},'
        '{"run": "r", "clip": "d.csv", "out": "p.csv"}]'
    )
    (tmp_path / "m.toml").write_text(
        '[[item]]\nrun = "r"\nclip = "c.csv"\nout = "o.csv"\nfrom = "a"\nto = "b"\nfps = 24\n'
        '[[item]]\nrun = "r"\nclip = "d.csv"\nout = "p.csv"\n'
    )
    expected = [Item("c.csv", "o.csv", "r", "a", "b", fps=24.0), Item("d.csv", "p.csv", "r")]
    assert [read_manifest(tmp_path / f"m.{kind}") for kind in ("csv", "json", "toml")] == [expected] * 3


GOOD = {"run": "r", "clip": "c", "out": "o"}


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        ([], "expected a list of items"),
        ({"a": 1}, "expected a list of items"),
        ([GOOD | {"clop": "x"}], "item 1: expected keys among clip, out, run, .*, got clop"),
        ([{"run": "r", "clip": "c"}], "item 1: expected clip and out"),
        ([GOOD | {"clip": 3}], "item 1: expected clip and out, and texts, got clip"),
        ([{"clip": "c", "out": "o"}], "item 1: expected a run, or a method with source and target"),
        ([GOOD | {"source": "a"}], "item 1: expected from and to beside a run"),
        ([GOOD | {"method": "magic"}], "item 1: expected a method among .*, got magic"),
        ([GOOD | {"fps": "fast"}], "item 1: expected fps above 0, up to 1000, got fast"),
        ([GOOD, GOOD | {"clip": "d"}], "expected an out of its own for each item, got .*o 2 times"),
    ],
)
def test_a_wrong_manifest_is_refused_before_any_work(rows, sentence, tmp_path):
    with pytest.raises(ReenactError, match=f"manifest.json: .*{sentence}|manifest.json: {sentence}"):
        read_manifest(_manifest(tmp_path, rows))


def test_what_is_no_manifest_or_no_table_is_refused(rows, tmp_path):
    with pytest.raises(FileNotFoundError, match="no such manifest"):
        read_manifest(tmp_path / "none.csv")
    (tmp_path / "m.json").write_text("{")
    with pytest.raises(ReenactError, match="expected JSON"):
        read_manifest(tmp_path / "m.json")
    (tmp_path / "m.txt").write_text("x")
    with pytest.raises(ReenactError, match=r"expected a manifest in .csv, .json or .toml, got .txt"):
        read_manifest(tmp_path / "m.txt")
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ReenactError, match="expected the table of a batch, got another file"):
        run_batch(_manifest(tmp_path, rows), tmp_path / "other.csv")
    rows[0]["out"] = f"{tmp_path / 'nowhere' / 'x.csv'}"
    assert run_batch(_manifest(tmp_path, rows[:1]), tmp_path / "results.csv")[0] == 1


def test_items_name_the_checkpoint_of_their_networks(older_run, tmp_path):
    names = (None, "best", 10, 7)
    rows = [
        {"run": f"{older_run}", "clip": "synthetic:3:1", "out": f"{tmp_path / f'{name}.csv'}"}
        | ({} if name is None else {"checkpoint": name})
        for name in names
    ]
    failed, made = run_batch(_manifest(tmp_path, rows), tmp_path / "results.csv")
    assert failed == 1
    assert "got 7; there are those of steps 10, 20 (best), 30" in made[3]["error"]
    moved = {name: ImageRetargeter.load(older_run, checkpoint=name) for name in ("newest", "best", "10")}
    for name, key in ((None, "newest"), ("best", "best"), (10, "10")):
        retargeter = moved[key]
        expected = retargeter(load_clip("synthetic:3:1", retargeter.source)).weights
        found = load_clip(f"{tmp_path / f'{name}.csv'}", retargeter.target).weights
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)  # as many digits as a table has
    alone = {"method": "copy", "source": "a", "target": "b", "clip": "c", "out": "d", "checkpoint": "best"}
    with pytest.raises(ReenactError, match="item 1: expected the networks of a run beside checkpoint, got method"):
        read_manifest(_manifest(tmp_path, [alone]))


def test_an_item_without_a_checkpoint_is_told_as_it_was_before_there_was_the_key():
    item = Item("clip.csv", "out.csv", run="runs/a", fps=25.0)
    assert item.digest == "faba46500fcabda3"
    assert Item("clip.csv", "out.csv", run="runs/a", fps=25.0, checkpoint="best").digest != item.digest
