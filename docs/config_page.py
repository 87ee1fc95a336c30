"""Writes docs/config.md, the page of all settings, from the docstrings of reenact/config.py.

python docs/config_page.py
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from dataclasses import fields, is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

sys.path.insert(0, str(Path(__file__).parents[1]))

from reenact import config

PAGE = Path(__file__).with_name("config.md")
HEAD = """# Every setting

A run is a TOML file that lists what differs from the defaults, and options of the same names on the command line, which
win: `reenact train --config FILE.toml --training.steps 2000`. An unknown key is refused, with the nearest known one. A
run folder keeps every value in `RUN/config.toml`. This page is made from [`reenact/config.py`](../reenact/config.py) by
`python docs/config_page.py`.
"""


def page() -> str:
    """The page, in Markdown."""
    parts = [HEAD, _section(config.Config, "", "## The rigs, at the top of the file")]
    for setting in fields(config.Config):
        kind = get_type_hints(config.Config)[setting.name]
        if is_dataclass(kind):
            parts.append(_section(kind, f"{setting.name}.", f"## [{setting.name}]"))
    return "\n".join(parts)


def _section(kind: type, prefix: str, title: str) -> str:
    about = "" if kind is config.Config else f"{_joined(inspect.getdoc(kind) or '')}\n\n"
    lines = [f"{title}\n\n{about}| setting | default | what it does |", "|---|---|---|"]
    hints, told, default = get_type_hints(kind), _docstrings(kind), kind()
    for setting in fields(kind):
        if is_dataclass(hints[setting.name]):
            continue
        words = told[setting.name]
        choices = [value for each in (hints[setting.name], *get_args(hints[setting.name])) for value in _choices(each)]
        if any(f"`{choice}`" not in words for choice in choices):
            words += f" One of {', '.join(f'`{choice}`' for choice in choices)}."
        allowed = config._ALLOWED.get(prefix + setting.name)
        words += f" *{allowed[0][0].upper()}{allowed[0][1:]}.*" if allowed else ""
        value = getattr(default, setting.name)
        lines.append(f"| `{setting.name}` | {_shown(value)} | {words.replace('|', chr(92) + '|')} |")
    return "\n".join(lines) + "\n"


def _choices(hint: Any) -> list[str]:
    return list(get_args(hint)) if get_origin(hint) is Literal else []


def _shown(value: Any) -> str:
    if value is None:
        return "not set"
    return f"`{config._toml_line('', value).removeprefix(' = ')}`"


def _docstrings(kind: type) -> dict[str, str]:
    """The text under each field."""
    body = ast.parse(inspect.getsource(kind)).body[0].body
    return {
        field.target.id: _joined(text.value.value)
        for field, text in pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr)
    }


def _joined(text: str) -> str:
    return re.sub(r"\s+", " ", text).strip()


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)
