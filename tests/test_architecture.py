"""Imports point one way: reads every import of the library and its leaves, those inside functions too."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LEAVES = ("tasks", "baselines", "leaderboard")
ENTRY_POINT_GROUPS = ("tslam_bench.policies", "tslam_bench.reconstructors")
BASE = (
    *("constants", "errors", "files", "grids", "hand_constants"),
    *("compiled", "curves", "machine", "extras", "episodes", "plugins", "text", "variants", "version"),
)
"""Modules of the library that lie in no folder and that everything may import."""
ALLOWED: dict[str, set[str]] = {
    "base": set(),
    "geometry": {"base"},
    "objects": {"base", "geometry"},
    "sources": {"base", "geometry", "objects"},
    "preparation": {"base", "geometry", "objects", "sources"},
    "engine": {"base", "geometry", "objects"},
    "reconstruction": {"base", "geometry", "objects"},
    "scoring": {"base", "geometry", "objects", "reconstruction"},
    "viewing": {"base", "geometry", "objects", "reconstruction", "scoring"},
    "registration": {"base", "engine"},
    "wrappers": {"base", "engine"},
    "evaluation": {"base", "engine", "objects", "reconstruction", "registration", "scoring", "viewing"},
    "front": {"base", "registration", "evaluation", "reconstruction", "wrappers"},
    "cli": {
        "base",
        "geometry",
        "objects",
        "sources",
        "preparation",
        "engine",
        "reconstruction",
        "scoring",
        "viewing",
        "evaluation",
        "registration",
    },
}
ALLOWED["leaf"] = {name for name in ALLOWED if name != "front"}
"""What the modules of each part may import besides their own part. A leaf imports no other leaf."""


def modules() -> dict[str, Path]:
    """Dotted name -> file, of the library and its leaves."""
    found = {}
    for folder in ("tslam_bench", *LEAVES):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            parts = parts if folder == "tslam_bench" else ("tslam_bench", *parts)
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def part(module: str) -> str:
    """The part of the architecture that a module belongs to."""
    parts = module.split(".")[1:]
    if not parts:
        return "front"
    if parts[0] in LEAVES:
        return "leaf"
    return "base" if parts[0] in BASE else parts[0]


def imports(module: str) -> set[tuple[str, bool]]:
    """(module of ours, relative) for every import statement of a file, wherever it stands."""
    path = MODULES[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    found: set[tuple[str, bool]] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {(alias.name, False) for alias in node.names if alias.name.split(".")[0] == "tslam_bench"}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*above, *([base] if base else [])])
            if base.split(".")[0] == "tslam_bench":
                for alias in node.names:
                    inner = f"{base}.{alias.name}"
                    found.add((inner if inner in MODULES else base, node.level > 0))
    return found


@pytest.mark.parametrize("module", MODULES)
def test_arrows_point_one_way(module: str) -> None:
    here = part(module)
    for target, relative in imports(module):
        assert target in MODULES, f"{module} imports {target}, which is not there"
        there = part(target)
        if here == "leaf" and there == "leaf":
            assert module.split(".")[1] == target.split(".")[1], f"leaf {module} imports another leaf, {target}"
            assert relative, f"{module} imports its sibling {target} by its full name; write a relative import"
            continue
        assert not relative, f"{module} imports {target} relatively; only leaves do"
        assert there == here or there in ALLOWED[here], f"{module} imports {target}: from {here} to {there}"


def test_no_files_import_each_other_in_a_circle() -> None:
    graph = {module: {target for target, _ in imports(module)} - {module} for module in MODULES}
    graph["tslam_bench"] = set()  # the front only hands out what others define
    done: set[str] = set()

    def visit(module: str, trail: tuple[str, ...]) -> None:
        assert module not in trail, "circle: " + " -> ".join([*trail[trail.index(module) :], module])
        if module not in done:
            for target in sorted(graph[module]):
                visit(target, (*trail, module))
            done.add(module)

    for module in sorted(graph):
        visit(module, ())


def test_every_folder_of_the_library_has_rules() -> None:
    assert {part(module) for module in MODULES} == set(ALLOWED)


def test_strings_that_name_modules_name_real_ones() -> None:
    """The library names its leaves by strings, which no tool follows: this one does."""
    named = set()
    for path in MODULES.values():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value not in ENTRY_POINT_GROUPS:
                text = node.value.partition(":")[0]
                if text.startswith("tslam_bench.") and text.replace(".", "").replace("_", "").isalnum():
                    named.add(text)
    assert named and {name for name in named if name not in MODULES} == set()


@pytest.mark.parametrize("module", MODULES)
def test_no_module_is_longer_than_400_lines(module: str) -> None:
    assert len(MODULES[module].read_text(encoding="utf-8").splitlines()) <= 400
