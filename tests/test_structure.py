"""The house rules that a program can check: sizes of files and folders, directions of imports, labels of arguments."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
import warpflag_kernels

import warpflag

DRIVER, KERNELS = Path(warpflag.__file__).parent, Path(warpflag_kernels.__file__).parent
ROOT = DRIVER.parent
PYTHON = [
    path for folder in (DRIVER, KERNELS, ROOT / "tests", ROOT / "examples") for path in sorted(folder.rglob("*.py"))
]
# From the bottom up: a folder imports from itself and from those before it.
FOLDERS = {
    "warpflag_kernels": ("base", "rod", "contact", "fluid", "motor", "stepping", "implicit", "thermal"),
    "warpflag": (
        *("base", "scene", "record", "observables", "model", "stepping", "view", "run"),
        *("sweep_command", "tradeoff_command", "view_command", "cli", "__main__"),
    ),
}


def test_no_file_is_over_400_lines():
    long = {str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").splitlines()) for path in PYTHON}
    assert {path: lines for path, lines in long.items() if lines > 400} == {}


def test_no_folder_has_more_than_14_files():
    counts: dict[str, int] = {}
    for path in PYTHON:
        if path.name != "__init__.py":
            folder = str(path.parent.relative_to(ROOT))
            counts[folder] = counts.get(folder, 0) + 1
    assert {folder: count for folder, count in counts.items() if count > 14} == {}


def module_of(path: Path) -> str:
    """Dotted name of a file."""
    root = DRIVER.parent if DRIVER in path.parents else KERNELS.parent
    return ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


def imports(path: Path, top_level: bool) -> set[str]:
    """Dotted names of this project's modules that a file imports.

    Args:
        path: of the file.
        top_level: leave out what is imported inside functions or for type checkers alone.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = tree.body if top_level else ast.walk(tree)
    found: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.partition(".")[0] in FOLDERS}


FILES = [path for path in PYTHON if DRIVER in path.parents or KERNELS in path.parents]


@pytest.mark.parametrize("path", FILES, ids=lambda path: module_of(path))
def test_imports_point_down(path):
    package, _, rest = module_of(path).partition(".")
    own, order = rest.partition(".")[0], FOLDERS[package]
    if own not in order:
        assert own in ("", "picture")  # the package itself; pictures stand alone
        return
    for name in imports(path, top_level=False):
        target, _, inner = name.partition(".")
        folder = inner.partition(".")[0]
        assert (package, target) != ("warpflag_kernels", "warpflag"), f"a kernel imports the driver: {name}"
        if target == package and folder in order:
            assert order.index(folder) <= order.index(own), f"{own} imports {name}"
        assert target != package or own == folder or folder != "picture", f"{own} imports {name}"


def test_imports_run_in_no_circle():
    # An `__init__` passes on what its folder's files define; that these import each other is no circle.
    files = [path for path in FILES if path.name != "__init__.py"]
    modules = {module_of(path): imports(path, top_level=True) for path in files}
    graph = {name: {other for other in found if other in modules and other != name} for name, found in modules.items()}
    done: set[str] = set()

    def visit(name: str, chain: tuple[str, ...]) -> None:
        assert name not in chain, " -> ".join((*chain[chain.index(name) :], name))
        if name not in done:
            for other in graph[name]:
                visit(other, (*chain, name))
            done.add(name)

    for name in graph:
        visit(name, ())


# Labels.

FUNCTION = ast.FunctionDef


def roots(node: ast.AST) -> str | None:
    """The name at the beginning of a.b.c[i].d."""
    while isinstance(node, ast.Attribute | ast.Subscript):
        node = node.value
    return node.id if isinstance(node, ast.Name) else None


def decorators(function: FUNCTION) -> str:
    return " ".join(ast.unparse(decorator) for decorator in function.decorator_list)


def cpp_written(function: FUNCTION, folder: Path) -> set[str]:
    """Arguments that the C++ of a native function writes to: those that a pointer that is not const is taken from, or
    that stand left of an assignment."""
    text = decorators(function)
    for name in re.findall(r"['\"](\w+)['\"]", text):
        file = folder / f"{name}.cpp"
        if file.exists():
            text += "\n" + file.read_text(encoding="utf-8")
    arguments = [argument.arg for argument in function.args.args]
    found = set()
    for statement in re.split(r"[;{}\n]", re.sub(r"//.*", "", text)):
        for name in arguments:
            pointer = re.search(rf"^\s*(\w+)\*.*=.*\b{name}\.[\w.]*data", statement) and "const" not in statement
            pointer = pointer or re.search(rf"auto&\s*\w+ = .*\b{name}\b", statement)
            stored = re.search(rf"\b{name}\.[\w.]*data\[[^\]]*\](\[\w+\])?\s*[-+]?=[^=]", statement)
            if pointer or stored:
                found.add(name)
    return found


def origins(tree: ast.Module, own: str) -> dict[str, tuple[str, str]]:
    """Where device functions come from that a file calls by a local name: (file, name there).

    Follows `a, b = file.functions(p).a, other.functions(p).b` and `f = file.functions(p)`.
    """
    files: dict[str, str] = {}  # of names that stand for a file or for functions from it
    found: dict[str, tuple[str, str]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            files |= {alias.asname or alias.name: alias.name for alias in node.names}

    def file_of(value: ast.AST) -> str:
        while isinstance(value, ast.Call | ast.Attribute):
            value = value.func if isinstance(value, ast.Call) else value.value
        return files.get(value.id, own) if isinstance(value, ast.Name) else own

    for node in ast.walk(tree):
        if not isinstance(node, ast.Assign) or len(node.targets) != 1:
            continue
        target, value = node.targets[0], node.value
        pairs = [(target, value)]
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            pairs = list(zip(target.elts, value.elts, strict=False))
        for name, expression in pairs:
            if isinstance(name, ast.Name) and isinstance(expression, ast.Attribute):
                found[name.id] = (file_of(expression.value), expression.attr)
            elif isinstance(name, ast.Name) and isinstance(expression, ast.Call):
                files[name.id] = file_of(expression)
    return found


# What is put together at run time, which no reading of the source finds: terms, and C++ in several files.
COMPOSED = {
    ("right_hand_side", "evaluate_cell"): {1, 2},
    ("right_hand_side", "evaluate_flagellum"): {1},
    ("combined", "settle"): {1},
    ("block_band_simd", "factorise"): {1},
    ("block_band_simd", "solve"): {1},
}


class Sources:
    """The device functions of all files, and which of their arguments they write to, themselves or through others."""

    def __init__(self) -> None:
        self.files = {path.stem: path for path in KERNELS.rglob("*.py") if path.stem != "__init__"}
        self.trees = {stem: ast.parse(path.read_text(encoding="utf-8")) for stem, path in self.files.items()}
        self.origins = {stem: origins(tree, stem) for stem, tree in self.trees.items()}
        self.functions = [
            (stem, node)
            for stem, tree in self.trees.items()
            for node in ast.walk(tree)
            if isinstance(node, FUNCTION) and "wp.func" in decorators(node)
        ]
        self.written: dict[tuple[str, str], set[int]] = {(stem, node.name): set() for stem, node in self.functions}
        self.written |= {name: set(positions) for name, positions in COMPOSED.items()}
        changed = True
        while changed:
            changed = False
            for stem, node in self.functions:
                new = self.positions(stem, node) - self.written[stem, node.name]
                self.written[stem, node.name] |= new
                changed = changed or bool(new)

    def positions(self, stem: str, function: FUNCTION) -> set[int]:
        """Positions of the arguments that a function or kernel of a file writes to, as far as is known."""
        names = [argument.arg for argument in function.args.args]
        found = cpp_written(function, self.files[stem].parent) if "func_native" in decorators(function) else set()
        local: set[str] = set()
        for node in ast.walk(function):
            targets = node.targets if isinstance(node, ast.Assign) else []
            targets = [node.target] if isinstance(node, ast.AugAssign) else targets
            for target in targets:
                for part in target.elts if isinstance(target, ast.Tuple) else [target]:
                    if isinstance(part, ast.Name):
                        local.add(part.id)
                    else:
                        found.add(roots(part))
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                written = self.written.get(self.origins[stem].get(called, (stem, called)), set())
                written = {0} if called.startswith("wp.atomic_") else written
                found |= {roots(node.args[position]) for position in written if position < len(node.args)}
        return {names.index(name) for name in found if name in names and name not in local}


def test_arguments_are_labelled_as_they_are_used():
    """What a kernel writes to stands under "Out", and what stands there is written to."""
    sources, wrong = Sources(), []
    assert sources.written["body", "sum_flagellum"] == {1} and sources.written["step_flow", "load"] == {0}
    assert sources.written["block_band_simd", "solve"] == {1, 4} and sources.written["quasi_newton", "dot"] == set()
    for stem, tree in sources.trees.items():
        lines = sources.files[stem].read_text(encoding="utf-8").splitlines()
        for function in ast.walk(tree):
            if not isinstance(function, FUNCTION) or "wp.kernel" not in decorators(function):
                continue
            label, labels = "", {}
            arguments = {argument.lineno: argument.arg for argument in function.args.args}
            for number in range(function.lineno, max(arguments, default=function.lineno) + 1):
                line = lines[number - 1].strip()
                if re.match(r"# (Scene|Model|State|Out):", line):
                    label = line[2:-1]
                if number in arguments:
                    labels[arguments[number]] = label
            written = sources.positions(stem, function)
            for position, name in enumerate(argument.arg for argument in function.args.args):
                if (position in written) != (labels[name] == "Out"):
                    said = "is written" if position in written else "is not written"
                    wrong.append(f"{stem}: {function.name}: {name} {said} and stands under {labels[name]}")
            for argument in function.args.args:
                kind = ast.unparse(argument.annotation) if argument.annotation else ""
                label = labels[argument.arg]
                if label == "" or (kind == "Model" and label != "Model") or (kind == "State" and label == "Model"):
                    wrong.append(
                        f"{stem}: {function.name}: {argument.arg}, a {kind}, stands under {label or 'nothing'}"
                    )
    assert wrong == []


def test_a_script_for_the_type_checker_uses_every_public_name():
    import warpflag

    used = (ROOT / "tests" / "scene" / "public_names.py").read_text(encoding="utf-8")
    assert [name for name in warpflag.__all__ if f" {name}" not in used and f"warpflag.{name}" not in used] == []


def private_names(code: str) -> list[str]:
    """Names that begin with an underscore which code reads or patches in something other than its own objects."""
    found = []
    for node in ast.walk(ast.parse(code)):
        names: list[str] = []
        if isinstance(node, ast.Attribute) and not (isinstance(node.value, ast.Name) and node.value.id == "self"):
            names = [node.attr]
        elif isinstance(node, ast.ImportFrom):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and "attr" in node.func.attr:
            patched = [part.value for part in node.args[:2] if isinstance(part, ast.Constant)]
            names = [part.rpartition(".")[2] for part in patched if isinstance(part, str)]
        found += [name for name in names if re.fullmatch(r"_(?!_|repr_\w+_$|replace$).*", name)]
    return sorted(found)


def test_tests_reach_for_public_names_alone():
    """They use options, plans and inputs made for the case; `_repr_html_` of notebooks and `_replace` are public."""
    patched = "a._b = c.d\nfrom e import _f\ng.setattr(h, '_i', j)\ng.setattr('k._l', m)\nself._n = a._repr_html_()\n"
    assert private_names(patched) == ["_b", "_f", "_i", "_l"]
    tests = [path for path in PYTHON if ROOT / "tests" in path.parents]
    found = {str(path.relative_to(ROOT)): private_names(path.read_text(encoding="utf-8")) for path in tests}
    assert {path: names for path, names in found.items() if names} == {}
