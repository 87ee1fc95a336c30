"""The commands: help, one sentence for a mistake, exit status."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from PIL import Image

from reenact import cli
from reenact.cli import main
from reenact.config import Config, config_to_dict, save_config
from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.files import load_clip, load_rig, save_clip, save_rig

ROOT = Path(__file__).parents[1]


def fails(capsys, *arguments):
    """The sentence that a mistake is answered with."""
    assert main([str(argument) for argument in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1, "one sentence on one line"
    return err.removeprefix("error: ").removesuffix("\n")


def explained(capsys, *arguments):
    with pytest.raises(SystemExit) as done:
        main(list(arguments))
    assert done.value.code == 0
    return " ".join(capsys.readouterr().out.replace("│", " ").split())


@pytest.fixture
def trained(monkeypatch):
    """Calls that reach the training, which does not run."""
    from reenact import training

    calls = []
    monkeypatch.setattr(training, "train", lambda config, resume=False: calls.append((config, resume)))
    return calls


def test_the_module_is_the_command():
    command = [sys.executable, "-m", "reenact", "inspect", "nowhere.glb"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert "error: nowhere.glb: " in done.stderr


def test_help_names_every_command(capsys):
    text = explained(capsys, "--help")
    assert all(f"• {name}" in text for name in cli.COMMANDS)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (
            "train",
            ["--config FILE.toml", "--resume", "--run", "--source", "--target", "--source-clip", "--target-clip"],
        ),
        (
            "train",
            [
                "--training.steps INT",
                "Optimizer steps; of ReenactNet alone",
                "--images.no-residual",
                "{found,pictures,none}",
            ],
        ),
        (
            "infer",
            [
                "RUN",
                "CLIP",
                "--out FILE",
                "--from RIG",
                "--to RIG",
                "--reverse",
                "--checkpoint newest|best|STEP",
                "--fps",
                "--post.gain",
                "Live Link Face",
            ],
        ),
        ("add", ["RUN", "RIG", "--run DIR", "--steps"]),
        ("batch", ["MANIFEST", "--results FILE.csv", "torchrun"]),
        (
            "evaluate",
            ["[RUN ...]", "--frames INT", "--checkpoint newest|best|STEP", "--seed INT", "--suite", "--methods NAME"],
        ),
        (
            "view",
            [
                "RUN|RIG",
                "--clip CLIP",
                "--checkpoint newest|best|STEP",
                "--method NAME",
                "--audio FILE.wav",
                "--nudges FILE.json",
                "--no-browser",
            ],
        ),
        (
            "render",
            [
                "[RUN] CLIP",
                "--checkpoint newest|best|STEP",
                "--out OUT",
                "--rig RIG",
                "--size INT",
                "--fps",
                "--opengl",
                "side by side",
            ],
        ),
        ("convert", ["IN", "OUT", "--rig RIG", "--parts NAME", "--fps", "--post.smooth FLOAT"]),
        ("inspect", ["--out FILE.png", "--json FILE.json", "--parts NAME", "looks wrong"]),
        ("rigs", ["--out FILE.png", "--size INT"]),
        ("doctor", ["--json", "what to do where something is missing or wrong"]),
    ],
)
def test_help_of_each_command_is_complete(command, words, capsys):
    text = explained(capsys, command, "--help")
    assert [word for word in words if word not in text] == []


def test_help_of_train_names_every_setting_and_its_default(capsys):
    text = explained(capsys, "train", "--help")
    for section, value in config_to_dict(Config()).items():
        for key, default in value.items() if isinstance(value, dict) else [("", value)]:
            option = f"{section}.{key}".rstrip(".").replace("_", "-")
            shown = "" if default in ((), {}) else str(default)
            found = re.search(rf"--{option}(, --\S+)? (\S+)( (?!--)\S+)*? \(default: {re.escape(shown)}\)", text)
            assert found, option


@pytest.mark.parametrize("script", ["train", "infer", "evaluate"])
def test_scripts_are_the_same_commands(script):
    done = subprocess.run(
        [sys.executable, ROOT / f"{script}.py", "--help"], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0
    assert f"usage: reenact {script}" in done.stdout


def test_help_does_not_load_what_takes_seconds_to_load():
    code = (
        "import sys, reenact.cli\n"
        "try: reenact.cli.main(['train', '--help'])\n"
        "except SystemExit: print([m for m in ('torch', 'numba', 'scipy', 'kornia') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_settings_come_from_defaults_then_the_file_then_the_command_line(trained, tmp_path):
    (tmp_path / "x.toml").write_text(
        "source = 'a.glb'\n[training]\nsteps = 7\nbatch_size = 3\n[images]\nmakeup = false"
    )
    arguments = [
        "train",
        "--config",
        f"{tmp_path / 'x.toml'}",
        "--training.steps",
        "9",
        "--training.learning-rate",
        "1e-4",
    ]
    assert main(arguments) == 0
    training = replace(Config().training, steps=9, batch_size=3, learning_rate=1e-4)
    expected = replace(Config(), source="a.glb", training=training, images=replace(Config().images, makeup=False))
    assert trained == [(expected, False)]


def test_both_spellings_of_an_option_are_read(trained, tmp_path):
    (tmp_path / "x.toml").write_text("source = 'a.glb'")
    assert main(["train", f"--config={tmp_path / 'x.toml'}", "--training.batch_size=4"]) == 0
    config, _ = trained[0]
    assert (config.source, config.training.batch_size) == ("a.glb", 4)


def test_a_resumed_run_takes_its_own_settings(trained, tmp_path):
    saved = replace(Config(), source="a.glb", run="moved/since", training=replace(Config().training, steps=5))
    save_config(saved, tmp_path / "config.toml")
    assert main(["train", "--run", f"{tmp_path}", "--resume"]) == 0
    assert trained == [(replace(saved, run=f"{tmp_path}"), True)]


def test_a_resumed_run_refuses_other_settings(trained, tmp_path, capsys):
    save_config(Config(), tmp_path / "config.toml")
    sentence = fails(capsys, "train", "--run", tmp_path, "--resume", "--training.steps", 9, "--source", "b")
    assert sentence.startswith(
        f"{tmp_path}: expected the settings that the run began with, got other source, training.steps; "
    )
    assert trained == []


def test_resuming_needs_a_run(trained, tmp_path, capsys):
    assert fails(capsys, "train", "--resume").startswith("--resume: expected the folder of a run beside it, got none")
    sentence = fails(capsys, "train", "--resume", "--run", tmp_path / "none")
    assert sentence.startswith(f"{tmp_path / 'none'}: expected a run folder with config.toml in it, got none")
    assert trained == []


def test_wrong_settings_are_one_sentence(trained, tmp_path, capsys):
    (tmp_path / "x.toml").write_text("[training]\nstesp = 7")
    sentence = fails(capsys, "train", "--config", tmp_path / "x.toml")
    assert sentence == f"{tmp_path / 'x.toml'}: unknown key training.stesp; did you mean training.steps?"
    assert "none.toml: there is no such settings file" in fails(capsys, "train", "--config", tmp_path / "none.toml")
    sentence = fails(capsys, "train", "--images.resolution", 72)
    assert sentence == "command line: images.resolution: expected a multiple of 16, from 16 to 1024, got 72"
    assert trained == []


def test_an_unknown_option_names_the_nearest(trained, capsys):
    with pytest.raises(SystemExit) as done:
        main(["train", "--training.stesp", "7"])
    assert done.value.code == 2
    assert "--training.steps" in capsys.readouterr().err
    assert trained == []


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ["infer", "{run}", "c.csv", "--out", "out.mp4"],
            "out.mp4: expected a name that ends in .csv or .npz or .json",
        ),
        (
            ["infer", "{run}", "c.csv", "--out", "out"],
            "out: expected a name that ends in .csv or .npz or .json",
        ),
        (
            ["infer", "{run}", "c.csv", "--out", "no/where/out.csv"],
            "no/where/out.csv: the folder no/where does not exist",
        ),
        (["infer", "{run}/none", "c.csv", "--out", "out.csv"], "{run}/none: expected a run folder with config.toml"),
        (["evaluate", "{run}/none"], "{run}/none: expected a run folder with config.toml in it, got none"),
        (["evaluate"], "evaluate: expected at least one run folder, got none"),
        (["convert", "{run}/rig.npz", "{run}/folder.glb"], "{run}/folder.glb: expected a file to write, got a folder"),
        (["convert", "{run}/rig.npz", "rig.mtl"], "rig.mtl: expected a name that ends in .glb or .npz or .obj"),
        (["convert", "{run}/none.npz", "rig.glb"], "{run}/none.npz: no such file"),
        (["convert", "anny:mna", "rig.glb"], "anny:mna: no such character; did you mean anny:man?"),
        (["convert", "synthetic:1:1", "{run}/c.csv"], "synthetic:1:1: expected --rig beside this clip, got none"),
        (["convert", "{run}/clip.npz", "{run}/c.glb"], "{run}/clip.npz: expected --rig beside this clip, got none"),
        (["rigs", "--out", "{run}/rigs.jpg"], "{run}/rigs.jpg: expected a name that ends in .png, got .jpg"),
        (["rigs", "--size", "5"], "--size: expected 16 to 1024 pixels, got 5"),
    ],
)
def test_a_mistake_is_one_sentence_before_any_work(arguments, sentence, tmp_path, toy_rig, capsys):
    save_config(Config(), tmp_path / "config.toml")
    save_rig(toy_rig, tmp_path / "rig.npz")
    save_clip(Clip(toy_rig.names, torch.zeros(2, len(toy_rig.names)), 30.0), tmp_path / "clip.npz")
    (tmp_path / "folder.glb").mkdir()
    arguments = [argument.format(run=tmp_path) for argument in arguments]
    assert fails(capsys, *arguments).startswith(sentence.format(run=tmp_path))


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (ReenactError("[red]x.glb[/red]: as it is"), 2, "error: [red]x.glb[/red]: as it is\n"),
        (
            PermissionError(13, "Permission denied", "a/b"),
            2,
            "error: a/b: Permission denied; name a place where you may read and write\n",
        ),
        (FileNotFoundError(2, "No such file or directory", "a"), 2, "error: a: No such file or directory\n"),
        (OSError(28, "No space left on device", "a"), 2, f"error: a: No space left on device{cli._REMEDIES[28]}\n"),
        (
            MemoryError(),
            2,
            "error: rigs: expected more memory than there is; take fewer vertices, shapes or "
            "frames, or smaller images\n",
        ),
        (KeyboardInterrupt(), 130, "stopped: by the keyboard\n"),
    ],
)
def test_errors_of_the_user_and_the_machine_are_one_line(error, status, text, monkeypatch, capsys):
    def fail():
        raise error

    monkeypatch.setitem(cli.COMMANDS, "rigs", fail)
    assert main(["rigs"]) == status
    assert capsys.readouterr().err == text


def test_our_own_mistakes_keep_their_traceback_and_say_how_to_report_them(monkeypatch, capsys):
    def fail():
        raise RuntimeError("ours")

    monkeypatch.setitem(cli.COMMANDS, "rigs", fail)
    assert main(["rigs"]) == 1
    err = capsys.readouterr().err
    assert err.startswith("Traceback (most recent call last):\n")
    assert "RuntimeError: ours\nour mistake: this is a fault in Reenact" in err
    assert "`reenact doctor`" in err


def test_warnings_are_one_line_each(monkeypatch, capsys):
    import warnings

    monkeypatch.setitem(cli.COMMANDS, "rigs", lambda: warnings.warn("a shape stays at 0", stacklevel=1))
    assert main(["rigs"]) == 0
    assert capsys.readouterr().err == "warning: a shape stays at 0\n"


def test_rigs_survive_conversion_to_glb_and_back(toy_rig, tmp_path, capsys):
    save_rig(toy_rig, tmp_path / "a.npz")
    assert main(["convert", f"{tmp_path / 'a.npz'}", f"{tmp_path / 'b.glb'}"]) == 0
    assert main(["convert", f"{tmp_path / 'b.glb'}", f"{tmp_path / 'c.npz'}"]) == 0
    assert capsys.readouterr().out.count("642 vertices, 1280 faces, 7 blendshapes") == 2
    again = load_rig(f"{tmp_path / 'c.npz'}")
    assert again.names == toy_rig.names
    # GLB may order vertices anew; the posed corners of the triangles are what must stay. float32 in both files.
    weights = torch.linspace(0, 1, len(toy_rig.names))
    corners, corners_again = (rig.vertices(weights)[rig.faces] for rig in (toy_rig, again))
    torch.testing.assert_close(corners_again, corners, rtol=0, atol=1e-6)


@pytest.mark.parametrize("with_rig", [False, True])
def test_clips_survive_conversion_through_every_format(with_rig, toy_rig, tmp_path):
    weights = torch.rand(12, len(toy_rig.names), generator=torch.Generator().manual_seed(1))
    clip = Clip(toy_rig.names, weights, 30.0)
    save_rig(toy_rig, tmp_path / "rig.npz")
    save_clip(clip, tmp_path / "a.table.csv")
    rig = ["--rig", f"{tmp_path / 'rig.npz'}"]
    chain = ["a.table.csv", "b.npz", "c.glb", "d.npz", "e.csv"]
    for source, target in pairwise(chain):
        options = rig if with_rig or target == "c.glb" else []
        # From .glb without a rig: only a .csv says that the clip is meant, not the rig.
        options = rig if source == "c.glb" else options
        assert main(["convert", f"{tmp_path / source}", f"{tmp_path / target}", *options]) == 0
    for name in chain:
        again = load_clip(f"{tmp_path / name}", toy_rig)
        assert again.fps == pytest.approx(30, abs=1e-3)  # time stamps in .csv have milliseconds or so
        torch.testing.assert_close(again.weights, weights, rtol=0, atol=2e-4)  # digits of a Live Link Face .csv


def test_the_clip_of_a_glb_goes_to_csv_without_a_rig(toy_rig, tmp_path):
    weights = torch.eye(len(toy_rig.names))
    save_clip(Clip(toy_rig.names, weights, 30.0), tmp_path / "a.glb", toy_rig)
    assert main(["convert", f"{tmp_path / 'a.glb'}", f"{tmp_path / 'b.csv'}"]) == 0
    torch.testing.assert_close(load_clip(f"{tmp_path / 'b.csv'}", toy_rig).weights, weights, rtol=0, atol=2e-4)


def test_a_clip_made_by_formula_is_written_for_a_rig(toy_rig, tmp_path, capsys):
    save_rig(toy_rig, tmp_path / "rig.npz")
    assert main(["convert", "synthetic:3:1", f"{tmp_path / 'c.npz'}", "--rig", f"{tmp_path / 'rig.npz'}"]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'c.npz'}: 30 frames, 1.0 s, 7 blendshapes\n"


def test_rigs_are_listed_and_drawn(toy_pair, tmp_path, monkeypatch, capsys):
    from reenact.rigs import anny, files

    cast = {"anny:ball": "round", "anny:egg": "tall"}
    monkeypatch.setattr(anny, "BUILT_IN", cast)
    monkeypatch.setattr(files, "load_rig", dict(zip(cast, toy_pair, strict=True)).__getitem__)
    assert main(["rigs", "--out", f"{tmp_path / 'x.png'}", "--size", "32"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines[:2]] == [["anny:ball", "round"], ["anny:egg", "tall"]]
    with Image.open(tmp_path / "x.png") as sheet:
        assert sheet.size == (6 * 32, 2 * (32 + 16))  # neutral and five expressions; a line of text over each row
        neutral, moved = (sheet.crop((32 * k, 16, 32 * k + 32, 48)) for k in (0, 2))
        assert neutral.tobytes() != moved.tobytes()


def test_the_console_script_exits_with_the_status():
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}"}
    done = subprocess.run(
        [sys.executable, "-m", "reenact.cli", "rigs", "--size", "1"],
        capture_output=True,
        text=True,
        env=environment,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: --size: expected 16 to 1024 pixels, got 1\n"


def test_colons_in_a_message_do_not_become_pictures(toy_rig, tmp_path, capsys):
    save_rig(toy_rig, tmp_path / "rig.npz")
    sentence = fails(capsys, "convert", "synthetic:x:", tmp_path / "c.npz", "--rig", tmp_path / "rig.npz")
    assert sentence.startswith("synthetic:x:: expected synthetic:SEED")


def test_public_names_are_there_and_load_nothing_until_they_are_used():
    code = (
        "import sys, reenact\n"
        "assert 'torch' not in sys.modules\n"
        "assert set(reenact.__all__) <= set(dir(reenact))\n"
        "assert all(getattr(reenact, name).__name__ == name for name in reenact.__all__)\n"
        "try: reenact.nothing\n"
        "except AttributeError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "module 'reenact' has no attribute 'nothing'\n"


@pytest.mark.parametrize(("given", "policy"), [({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")])
def test_idle_threads_sleep_unless_the_user_says_otherwise(given, policy):
    environment = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"} | given
    code = "import os, sys, reenact.cli; assert 'torch' not in sys.modules; print(os.environ['OMP_WAIT_POLICY'])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True, env=environment
    )
    assert done.stdout.strip() == policy


def test_a_reader_that_has_gone_is_no_error():
    command = [sys.executable, "-m", "reenact", "train", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        running.stdout.close()
        assert running.stderr.read() == ""
    assert running.returncode == 141


def test_a_rate_that_is_asked_for_is_said_and_a_result_is_finished_as_asked(tmp_path, capsys, toy_rig):
    save_rig(toy_rig, tmp_path / "ball.npz")
    arguments = ["convert", "synthetic:3:2", f"{tmp_path / 'c.npz'}", "--rig", f"{tmp_path / 'ball.npz'}"]
    assert main([*arguments, "--fps", "24", "--post.lock", "eyeBlink*", "0.25"]) == 0
    assert "60 frames at 30 fps became 48 at 24" in capsys.readouterr().out
    clip = load_clip(str(tmp_path / "c.npz"), toy_rig)
    assert (len(clip), clip.fps) == (48, 24.0)
    assert torch.equal(clip.weights[:, :2], torch.full((48, 2), 0.25))
    assert "no shape is called jaw" in fails(capsys, *arguments, "--post.gain", "jaw", "2")


def test_an_avatar_is_animated_and_keeps_what_it_had(tmp_path):
    avatar = ROOT / "tests" / "fixtures" / "blender.glb"
    assert main(["convert", "synthetic:3:1", f"{tmp_path / 'moved.glb'}", "--rig", f"{avatar}"]) == 0
    kept, moved = load_rig(str(avatar)), load_rig(str(tmp_path / "moved.glb"))
    assert torch.equal(kept.deltas, moved.deltas)
    assert b"skins" in (tmp_path / "moved.glb").read_bytes()
    again = load_clip(str(tmp_path / "moved.glb"), moved)
    torch.testing.assert_close(again.weights, load_clip("synthetic:3:1", kept).weights, rtol=0, atol=1e-6)  # float32


def test_an_animation_comes_along_with_its_rig(tmp_path, capsys):
    avatar = ROOT / "tests" / "fixtures" / "blender.glb"
    assert main(["convert", f"{avatar}", f"{tmp_path / 'x.glb'}"]) == 0
    assert "12 frames at 24 fps" in capsys.readouterr().out
    assert main(["convert", f"{avatar}", f"{tmp_path / 'x.npz'}", "--shapes", "eye*"]) == 0
    assert load_rig(str(tmp_path / "x.npz")).names == ("eyeBlinkRight", "eyeBlinkLeft")


def test_inspect_says_what_is_inside_and_draws_it(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    avatar = ROOT / "tests" / "fixtures" / "blender.glb"
    assert main(["inspect", f"{avatar}", "--json", "facts.json", "--size", "32"]) == 0
    text = capsys.readouterr().out
    for words in ("115 vertices", "Khronos glTF Blender", "Teeth", "12 keys", "16 x 16, PNG", "jawOpen"):
        assert words in text
    assert "mouthSmileLeft has no partner on the other side" in text
    with Image.open("blender-shapes.png") as sheet:
        assert sheet.width >= 4 * 32
    assert '"strength"' in Path("facts.json").read_text()


def test_inspect_of_what_is_no_rig_is_one_sentence(tmp_path, capsys):
    (tmp_path / "x.glb").write_bytes(b"glTF")
    assert "expected a GLB file" in fails(capsys, "inspect", tmp_path / "x.glb")
    assert "expected 16 to 1024 pixels" in fails(capsys, "inspect", "anny:man", "--size", 3)


def test_a_geometric_method_needs_no_run(tmp_path, toy_pair, capsys):
    names = []
    for rig in toy_pair:
        names.append(f"{tmp_path / rig.name}.npz")
        save_rig(rig, names[-1])
    rigs = ["--source", names[0], "--target", names[1]]
    (tmp_path / "pairs.csv").write_text("source,target\n" + "".join(f"{v},{v}\n" for v in range(0, 642, 2)))
    out = tmp_path / "c.npz"
    arguments = ["infer", "synthetic:3:2", "--method", "rbf", *rigs, "--correspondence", f"{tmp_path / 'pairs.csv'}"]
    assert main([*arguments, "--out", f"{out}"]) == 0
    assert "60 frames, 2.0 s, ball -> egg" in capsys.readouterr().out
    moved, truth = load_clip(str(out), toy_pair[1]), load_clip("synthetic:3:2", toy_pair[0])
    assert float((moved.weights - truth.weights).abs().mean()) < 0.1
    assert "expected one of neutral, copy" in fails(capsys, "infer", "c.csv", "--method", "magic", *rigs, "--out", out)
    assert "expected CLIP with --source and --target" in fails(
        capsys, "infer", "c.csv", "--method", "rbf", "--out", out
    )
    assert "expected --method beside --source, --target" in fails(
        capsys, "infer", tmp_path, "c.csv", *rigs, "--out", out
    )
    assert "expected RUN and CLIP, got 1" in fails(capsys, "infer", "c.csv", "--out", out)


def test_markers_drive_a_rig_without_a_source(tmp_path, toy_rig, capsys):
    import numpy as np

    from reenact.retargeting.correspondence import Places
    from reenact.retargeting.markers import Markers

    save_rig(toy_rig, tmp_path / "ball.npz")
    chosen = torch.arange(0, 642, 9)
    clip = load_clip("synthetic:3:10", toy_rig)
    take = Markers.from_rig(toy_rig, Places.at(chosen), clip.weights, 30.0)
    np.savez(tmp_path / "take.npz", positions=take.positions.numpy(), names=np.array(take.names), fps=30.0)
    rows = [f"{name},{vertex}" for name, vertex in zip(take.names, chosen.tolist())]
    (tmp_path / "places.csv").write_text("\n".join(["marker,vertex", *rows]))
    arguments = ["infer", f"{tmp_path / 'take.npz'}", "--method", "quantile", "--target", f"{tmp_path / 'ball.npz'}"]
    arguments += ["--out", f"{tmp_path / 'c.npz'}"]
    assert "expected --correspondence beside markers" in fails(capsys, *arguments)
    assert main([*arguments, "--correspondence", f"{tmp_path / 'places.csv'}"]) == 0
    moved = load_clip(str(tmp_path / "c.npz"), toy_rig)
    assert float((moved.weights - clip.weights).abs().mean()) < 0.1


def test_the_suite_prints_a_table_of_methods(capsys, monkeypatch, tmp_path):
    from reenact import suite

    monkeypatch.setattr(suite, "TARGETS", ("anny:woman",))
    monkeypatch.setattr(suite, "find_correspondence", lambda *_: None)
    out = tmp_path / "rows.jsonl"
    arguments = ["evaluate", "--suite", "geometric", "--methods", "copy", "neutral", "rbf", "--frames", "36"]
    assert main([*arguments, "--seeds", "2", "--results", f"{out}"]) == 0
    text = capsys.readouterr().out
    assert "| copy | 0.000 ± 0.000 |" in text  # the same names and the same ranges
    assert "| neutral | 1.000 ± 0.000 |" in text
    assert "rbf: anny:man to anny:woman: proportion matching needs a correspondence" in text
    assert len(out.read_text()) > 100
    assert "expected methods among" in fails(capsys, "evaluate", "--suite", "geometric", "--methods", "magic")


def test_a_geometric_method_takes_the_rigs_of_a_run(tmp_path, toy_run, capsys):
    out = tmp_path / "c.npz"
    assert (
        main(["infer", f"{toy_run.folder}", "synthetic:3:1", "--method", "copy", "--reverse", "--out", f"{out}"]) == 0
    )
    assert "egg -> ball" in capsys.readouterr().out
    sentence = fails(capsys, "infer", toy_run.folder, "c.csv", "--method", "copy", "--source", "x", "--out", out)
    assert "either a RUN or --source and --target" in sentence


def test_commands_take_the_checkpoint_that_is_asked_for_and_name_it(older_run, tmp_path, capsys):
    command = ["infer", f"{older_run}", "synthetic:1:1", "--out", f"{tmp_path / 'x.csv'}", "--checkpoint"]
    for which, said in (("newest", "ball -> egg"), ("best", "ball -> egg, of step 20"), ("10", "egg, of step 10")):
        assert main([*command, which]) == 0
        assert capsys.readouterr().out.endswith(f"{said}\n")
    command = ["render", f"{older_run}", "synthetic:1:1", "--out", f"{tmp_path / 'x.gif'}", "--size", "16"]
    assert main([*command, "--checkpoint", "best"]) == 0
    assert capsys.readouterr().out.endswith("ball, egg, of step 20\n")
    for first in (["infer"], ["render"], ["view"], ["evaluate"]):
        clip = [] if first == ["evaluate"] else ["synthetic:1:1"] if first != ["view"] else ["--clip", "synthetic:1:1"]
        out = ["--out", tmp_path / "y.gif"] if first == ["render"] else ["--out", tmp_path / "y.csv"]
        out = out if first in (["infer"], ["render"]) else []
        sentence = fails(capsys, *first, older_run, *clip, *out, "--checkpoint", "15")
        assert "expected newest, best or a step that was saved, got 15; there are those of steps 10, 20 (best), 30" in (
            sentence
        )


def test_a_checkpoint_without_networks_is_refused(older_run, toy_config, tmp_path, capsys):
    rigs = [toy_config.source, toy_config.target]
    out, best = ["--out", tmp_path / "x.csv"], ["--checkpoint", "best"]
    clip = "synthetic:1:1"
    for words, *arguments in (
        (
            "infer: expected networks beside --checkpoint, got --method copy",
            "infer",
            older_run,
            clip,
            "--method",
            "copy",
        ),
        ("view: expected a run beside --checkpoint, got ", "view", *rigs),
        ("evaluate: expected runs beside --checkpoint, got --suite geometric", "evaluate", "--suite", "geometric"),
        ("render: expected the networks of a run beside --checkpoint, got no run", "render", clip, "--rig", rigs[0]),
        ("beside --checkpoint, got --method copy", "render", older_run, clip, "--method", "copy"),
    ):
        into = {"infer": out, "render": ["--out", tmp_path / "x.gif"]}.get(arguments[0], [])
        sentence = fails(capsys, *arguments, *into, *best)
        assert words in sentence
        assert sentence.endswith("leave one of them out")


def test_an_evaluation_keeps_the_step_of_its_networks_and_its_report_takes_them_again(older_run, capsys):
    import json

    from reenact import report

    command = ["evaluate", f"{older_run}", "--frames", "18"]
    assert main([*command, "--checkpoint", "best"]) == 0
    assert "older, of step 20: ball -> egg" in " ".join(capsys.readouterr().out.split())
    assert json.loads((older_run / "evaluation" / "metrics.json").read_text())["checkpoint"] == 20
    page = (older_run / "report.html").read_text()
    assert "of step 20" in page
    assert "--seed 0 --checkpoint 20" in page
    assert report.main([f"{older_run}"]) == 0
    assert (older_run / "report.html").read_text() == page
    (older_run / "checkpoints" / "step-00000020.safetensors").unlink()
    assert report.main([f"{older_run}"]) == 2
    assert "got 20; there are those of steps 10, 30 (best)" in capsys.readouterr().err
    assert main(command) == 0
    assert "checkpoint" not in json.loads((older_run / "evaluation" / "metrics.json").read_text())
