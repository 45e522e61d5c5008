"""Measures the shape of the product: `python tools/house/shape.py`.

Files per folder, lengths of modules and functions, import cycles and upward imports, size of the
command line, exported names, and long documentation lines. The limits are in
`tests/repository/test_shape.py`. Tests, benchmarks, tools and examples are not counted.
"""

from __future__ import annotations

import ast
import re
import statistics
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: Lower ranks import from higher ones; packages of the same rank do not import each other.
RANKS = {
    "cdpr": 0,
    "calibration": 1,
    "executor": 2,
    "simulation": 3,
    "planner": 4,
    "drivers": 4,
    "tracking": 4,
    "model": 5,
}
SHORT_MODULE = 60
LINE = 120
Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Module:
    """A module of the product.

    Attributes:
        path: Relative to the repository's root.
        text: Its content.
    """

    path: str
    text: str

    @cached_property
    def tree(self) -> ast.Module:
        """Its syntax tree."""
        return ast.parse(self.text, self.path)

    @cached_property
    def name(self) -> str:
        """Import name."""
        return self.path[: -len(".py")].replace("/", ".").removesuffix(".__init__")

    @property
    def lines(self) -> int:
        """Number of lines."""
        return self.text.count("\n")

    @property
    def is_bare_init(self) -> bool:
        """Whether it is a short `__init__`, which is not counted as a module."""
        return self.path.endswith("__init__.py") and self.lines < 40

    def functions(self) -> Iterator[tuple[str, int]]:
        """Yields each function with its number of lines without the docstring."""
        for node in ast.walk(self.tree):
            if isinstance(node, Function):
                text = ast.get_docstring(node, clean=False)
                doc = 0 if text is None else text.count("\n") + 1
                yield f"{self.path}:{node.name}", (node.end_lineno or 0) - node.lineno + 1 - doc

    def imports(self) -> Iterator[str]:
        """Names imported at run time, at the top or inside a function."""
        for node in _executed(self.tree):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                yield node.module
                yield from (f"{node.module}.{alias.name}" for alias in node.names)

    def inner_imports(self) -> int:
        """Number of import statements inside functions."""
        found: set[ast.AST] = set()
        for node in ast.walk(self.tree):
            if isinstance(node, Function):
                found |= {n for n in ast.walk(node) if isinstance(n, ast.Import | ast.ImportFrom)}
        return len(found)

    def prints(self) -> int:
        """Number of calls of `print` and `input`."""
        return sum(
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id in ("print", "input")
            for node in ast.walk(self.tree)
        )

    def exported(self) -> tuple[str, ...]:
        """The names in its ``__all__``."""
        for node in self.tree.body:
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
                return tuple(ast.literal_eval(node.value))
        return ()


def _executed(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes except those below `if TYPE_CHECKING:`."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            yield from (n for other in child.orelse for n in _executed(other))
            continue
        yield child
        yield from _executed(child)


class House:
    """The product's modules in a folder."""

    def __init__(self, root: Path = ROOT) -> None:
        """Reads every module."""
        self.root = root
        paths = [p for package in RANKS for p in sorted((root / package).rglob("*.py"))]
        self.modules = [Module(p.relative_to(root).as_posix(), p.read_text("utf-8")) for p in paths]
        self.by_name = {module.name: module for module in self.modules}
        self.counted = [module for module in self.modules if not module.is_bare_init]

    @cached_property
    def edges(self) -> dict[str, set[str]]:
        """The modules that each module imports."""
        return {
            m.name: {n for n in m.imports() if n in self.by_name and n != m.name}
            for m in self.modules
        }

    def folders(self) -> Counter[str]:
        """Number of Python files per folder."""
        return Counter(str(Path(module.path).parent) for module in self.modules)

    def circles(self) -> list[list[str]]:
        """Import cycles: groups of modules that import each other, directly or indirectly."""
        reached = {name: self._reached(name) for name in self.edges}
        groups = {
            tuple(sorted({name} | {o for o in reached[name] if name in reached[o]}))
            for name in self.edges
        }
        return sorted(list(group) for group in groups if len(group) > 1)

    def _reached(self, name: str) -> set[str]:
        found: set[str] = set()
        rest = list(self.edges[name])
        while rest:
            other = rest.pop()
            if other not in found:
                found.add(other)
                rest += self.edges[other]
        return found

    def back_arrows(self) -> list[str]:
        """Imports from a package of lower rank, or from another of the same rank."""
        return sorted(
            f"{name} -> {other}"
            for name, others in self.edges.items()
            for other in others
            if (a := name.split(".")[0]) != (b := other.split(".")[0]) and RANKS[b] <= RANKS[a]
        )

    def functions(self) -> list[tuple[int, str]]:
        """Lengths and names of functions, longest first."""
        found = ((lines, name) for module in self.modules for name, lines in module.functions())
        return sorted(found, reverse=True)

    def namesakes(self) -> dict[str, list[str]]:
        """Names of public classes defined in several modules, with the modules."""
        found: dict[str, list[str]] = {}
        for module in self.modules:
            for node in module.tree.body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    found.setdefault(node.name, []).append(module.name)
        return {name: modules for name, modules in found.items() if len(modules) > 1}

    def single_importers(self) -> list[str]:
        """Modules imported by exactly one other module."""
        count = Counter(other for others in self.edges.values() for other in others)
        return [module.name for module in self.counted if count[module.name] == 1]

    def long_lines(self) -> list[str]:
        """Too long documentation lines, as ``file:line``."""
        pages = [*self.root.glob("*.md"), *sorted((self.root / "docs").rglob("*.md"))]
        return [
            f"{page.relative_to(self.root)}:{number}"
            for page in pages
            for number in long_lines(page.read_text("utf-8"))
        ]


def long_lines(text: str) -> list[int]:
    """Numbers of lines longer than `LINE`, except tables, code, comments and single links."""
    found, in_code = [], False
    for number, line in enumerate(text.splitlines(), start=1):
        if line.lstrip().startswith("```"):
            in_code = not in_code
        elif len(line) > LINE and not in_code and not line.lstrip().startswith(("|", "<!--")):
            bare = re.sub(r"^\s*(?:[-*]|\d+\.)?\s*", "", line)
            if not re.fullmatch(r"!?\[[^\]]*\]\([^)]*\)\S*|\S+", bare):
                found.append(number)
    return found


def figures(house: House) -> Iterator[tuple[str, str]]:
    """Names and values to print."""
    sizes = [module.lines for module in house.counted]
    short = sum(size <= SHORT_MODULE for size in sizes)
    cli = [module for module in house.modules if module.path.startswith("cdpr/cli/")]
    outside = [module for module in house.modules if module not in cli]
    yield "lines", str(sum(module.lines for module in house.modules))
    yield "fullest folders", ", ".join(f"{f} {n}" for f, n in house.folders().most_common(4))
    yield "modules", f"{len(sizes)}, median {statistics.median(sizes):.0f} lines"
    yield f"modules up to {SHORT_MODULE} lines", f"{short} ({100 * short / len(sizes):.0f} %)"
    largest = sorted(((m.lines, m.path) for m in house.counted), reverse=True)[:4]
    yield "largest modules", ", ".join(f"{path} {lines}" for lines, path in largest)
    yield "largest functions", ", ".join(f"{name} {n}" for n, name in house.functions()[:4])
    yield "circles of modules", "; ".join(" = ".join(c) for c in house.circles()) or "0"
    yield "back arrows", "; ".join(house.back_arrows()) or "0"
    yield "command line", f"{sum(module.lines for module in cli)} lines in {len(cli)} files"
    yield "its imports inside functions", str(sum(module.inner_imports() for module in cli))
    yield "prints outside it", str(sum(module.prints() for module in outside))
    for package in RANKS:
        yield f"names of {package}", str(len(house.by_name[package].exported()))
    namesakes = house.namesakes()
    yield "classes of one name", f"{len(namesakes)} {' '.join(sorted(namesakes))}"
    yield "modules with one importer", str(len(house.single_importers()))
    yield f"documentation lines over {LINE}", str(len(house.long_lines()))


def main() -> None:
    """Prints the figures."""
    for name, value in figures(House()):
        print(f"{name:32} {value}")


if __name__ == "__main__":
    main()
