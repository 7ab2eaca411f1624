"""Sphinx configuration: pages in Markdown, API pages from the docstrings.

Built by `uv run --group docs sphinx-build -W -q docs docs/_build`.
"""

import ast
import fnmatch
import itertools
import re
from collections.abc import Iterator
from pathlib import Path

from sphinx.util import logging

import warpflag

project = "warpflag"
author = "the warpflag authors"
release = version = warpflag.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.apidoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
]
exclude_patterns = ["_build", "api/*/modules.rst"]
html_theme = "furo"
html_title = f"warpflag {release}"
html_static_path = []

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

# A page per module of both packages. `__init__` modules only gather what their modules define.
apidoc_automodule_options = {"members", "show-inheritance", "ignore-module-all"}
apidoc_module_first = True
apidoc_separate_modules = True
apidoc_modules = [
    {"path": path, "destination": f"api/{name}"}
    for name, path in (("driver", "../warpflag"), ("kernels", "../kernels/warpflag_kernels"))
]
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_custom_sections = [("Errors", "Raises"), "Source"]

_SECTION = re.compile(r"(Args|Returns|Raises|Errors|Attributes|Source|Yields|Example):$")


def as_restructured_text(lines: list[str]) -> list[str]:
    """A docstring, which is plain text with code in backticks, as reStructuredText.

    Characters that would be markup are escaped, code gets its double backticks, and an indented block after a
    blank line (an equation, a list of functions) becomes a literal block.
    """
    out: list[str] = []
    text = 0  # indentation of the text that a block is indented against: deeper inside a section's entry
    block = 0  # indentation of the literal block that the line lies in, 0 outside
    for i, line in enumerate(lines):
        indent = len(line) - len(line.lstrip())
        if line.strip():
            if indent < block:
                block = 0
            if indent == 0:
                text = 8 if _SECTION.match(line) else 0
            blank_before = i > 0 and not lines[i - 1].strip()
            if not block and blank_before and indent >= max(text, 4) and not line.lstrip().startswith("- "):
                out += [" " * text + "::", ""]
                block = indent
        out.append(" " * text + line if block else escaped(line))
    return out


def escaped(line: str) -> str:
    """One line outside a literal block."""
    parts = re.split(r"(``[^`]*``|:\w+:`[^`]*`|`[^`]*`)", line)
    for i, part in enumerate(parts):
        if i % 2 == 0:
            bullet = re.match(r"\s*- ", part)
            start = bullet.end() if bullet else 0
            parts[i] = part[:start] + re.sub(r"([*|\\])|(?<=\w)_(?!\w)", lambda m: "\\" + m.group(0), part[start:])
        elif part.startswith("`") and not part.startswith("``"):
            parts[i] = f"`{part}`"
    return "".join(parts)


def escape_docstring(_app: object, _what: str, _name: str, _obj: object, _options: object, lines: list[str]) -> None:
    lines[:] = as_restructured_text(lines)


def skip_what_is_defined_elsewhere(
    app: object, what: str, _name: str, member: object, skip: bool, _options: object
) -> bool | None:
    """Packages pass on what their modules define; it is documented there, once."""
    here = app.env.temp_data.get("autodoc:module")  # type: ignore[attr-defined]
    elsewhere = what == "module" and getattr(member, "__module__", here) != here
    return True if skip or elsewhere else None


def drop_empty_patterns(app: object, docname: str, source: list[str]) -> None:
    """The index lists pages by pattern, some of them yet to come: patterns that match no page go."""
    if docname == "index":
        pages = app.env.found_docs  # type: ignore[attr-defined]
        lines = source[0].splitlines()
        source[0] = "\n".join(x for x in lines if not x.endswith("*") or fnmatch.filter(pages, x))


def check_constants(_app: object) -> None:
    """Warns of every named number without a reason: a row of numerics.md, or words beside it.

    Those of the kernels and steppers, of the model and of the measures, which change results, need the row. For the
    rest (buffers, intervals, pictures) some words do: a comment on its line or above it, or a docstring.
    """
    here = Path(__file__).parent
    rows = (here / "numerics.md").read_text(encoding="utf-8")
    driver = here / "../warpflag"
    of_results = [driver / folder for folder in ("stepping", "model", "observables", "scene")]
    files = [*(here / "../kernels/warpflag_kernels").rglob("*.py"), *driver.rglob("*.py")]
    for path in sorted(files):
        needs_row = driver not in path.parents or any(folder in path.parents for folder in of_results)
        text = path.read_text(encoding="utf-8")
        for names, words in numbers_of(text):
            for name in names:
                row = rf"^\|[^|]*\b{name}\b[^|]*\|[^|]*{path.parent.name}/{path.name}"
                if not re.search(row, rows, re.MULTILINE) and (needs_row or len(words.split()) < 3):
                    logging.getLogger(__name__).warning("numerics.md has no row for %s of %s", name, path.name)


def numbers_of(text: str) -> Iterator[tuple[list[str], str]]:
    """Names of the numbers that a module defines, and the words that stand beside each definition."""
    body, lines = ast.parse(text).body, text.splitlines()
    for statement, after in itertools.zip_longest(body, body[1:]):
        if not isinstance(statement, ast.Assign):
            continue
        targets = [part for target in statement.targets for part in getattr(target, "elts", [target])]
        names = [part.id for part in targets if isinstance(part, ast.Name) and part.id.isupper()]
        values = [x.value for x in ast.walk(statement.value) if isinstance(x, ast.Constant)]
        made_by_code = any(isinstance(x, ast.Lambda) for x in ast.walk(statement.value))
        if not names or made_by_code or not any(type(value) in (int, float) for value in values):
            continue
        words = [line.partition("# ")[2] for line in lines[statement.lineno - 1 : statement.end_lineno]]
        above = itertools.takewhile(lambda line: line.startswith("#"), reversed(lines[: statement.lineno - 1]))
        words += [line.removeprefix("#") for line in above]
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            words.append(str(after.value.value))
        yield names, " ".join(words)


def setup(app: object) -> None:
    app.connect("source-read", drop_empty_patterns)  # type: ignore[attr-defined]
    app.connect("builder-inited", check_constants)  # type: ignore[attr-defined]
    # Before napoleon, whose priority is 500.
    app.connect("autodoc-process-docstring", escape_docstring, priority=400)  # type: ignore[attr-defined]
    app.connect("autodoc-skip-member", skip_what_is_defined_elsewhere)  # type: ignore[attr-defined]
