"""The documentation: its snippets run in their order, its lists are up to date, its links lead somewhere."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture
def untouched():
    """Methods and characters are after the test what they were before."""
    from reenact.retargeting import METHODS
    from reenact.rigs import anny

    before = [(table, dict(table)) for table in (METHODS, anny.CAST)]
    yield
    for table, entries in before:
        table.clear()
        table.update(entries)


@pytest.mark.parametrize(
    "page", ["renderer.md", "formats.md", "viewer.md", "anacondar.md", "evaluation.md", "extending.md"]
)
def test_the_snippets_of_a_page_run(page, tmp_path, monkeypatch, untouched):
    monkeypatch.chdir(tmp_path)
    snippets = re.findall(r"^```python\n(.*?)^```", (DOCS / page).read_text(), re.MULTILINE | re.DOTALL)
    assert snippets
    names: dict = {}
    for number, snippet in enumerate(snippets):
        exec(compile(snippet, f"{page}, snippet {number + 1}", "exec"), names)


def test_the_page_of_settings_is_up_to_date():
    spec = importlib.util.spec_from_file_location("config_page", DOCS / "config_page.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    text = module.page()
    assert (DOCS / "config.md").read_text(encoding="utf-8") == text, "run `python docs/config_page.py`"
    assert "| `steps` | `5000` | Optimizer steps; of ReenactNet alone where it is trained first." in text
    assert "*A multiple of 16, from 16 to 1024.*" in text


def test_every_page_is_in_the_table_of_contents():
    listed = re.search(r"```\{toctree\}\n(.*?)```", (DOCS / "index.md").read_text(), re.DOTALL)[1].split()
    assert {name for name in listed if not name.startswith(":")} == {path.stem for path in DOCS.glob("*.md")} - {
        "index"
    }


def test_the_documentation_builds_without_a_broken_link(tmp_path, capfd):
    build = pytest.importorskip("sphinx.cmd.build", reason="needs sphinx, of the extra docs")
    for name in ("myst_parser", "furo"):
        pytest.importorskip(name, reason="of the extra docs")
    arguments = ["-b", "html", "-q", "-W", "--keep-going", "-d", str(tmp_path / "cache"), str(DOCS)]
    assert build.main([*arguments, str(tmp_path / "html")]) == 0, capfd.readouterr().err
    for page in (tmp_path / "html").glob("*.html"):
        asked = re.findall(r'(?:src|href)="(https?:[^"]*)"', re.sub(r"<a [^>]*>", "", page.read_text()))
        assert asked == [], page.name  # nothing is loaded from elsewhere
