"""Breaks the safety gate and the watch in every small way and counts what the tests notice.

Run it as ``python tests/executor/safety/mutation.py``; it prints every change that no test saw and
fails when more than one in twenty was missed. It is no part of the test run: it takes minutes.
Idea: opendbc's ``safety/tests/mutation.py``.
"""

from __future__ import annotations

import ast
import contextlib
import copy
import io
import os
import signal
import sys
import types
from collections.abc import Iterator
from pathlib import Path

import hypothesis  # loaded once, before the child processes
import numpy
import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
MODULES = {
    "gate": "test_gate.py",
    "watch": "test_watch.py",
    "stuck": "test_stuck.py",
    "limits": "test_limits.py",
}
PATIENCE_S = 60
WANTED = 0.95
COMPARED = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
}
COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """Every small change of one node."""
    if isinstance(node, ast.Compare):
        for place, operator in enumerate(node.ops):
            for other in COMPARED.get(type(operator), ()):
                changed = copy.deepcopy(node)
                changed.ops[place] = other()
                yield changed
    elif isinstance(node, ast.BoolOp):
        changed = copy.deepcopy(node)
        changed.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        yield changed
        for place in range(len(node.values)):
            rest = [v for i, v in enumerate(node.values) if i != place]
            yield ast.BoolOp(node.op, rest) if len(rest) > 1 else rest[0]
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield node.operand
    elif isinstance(node, ast.BinOp) and type(node.op) in COMPUTED:
        yield ast.BinOp(node.left, COMPUTED[type(node.op)](), node.right)
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        yield ast.Constant(node.value + 1)
        yield ast.Constant(node.value - 1)
    elif isinstance(node, ast.Constant) and type(node.value) is bool and not hasattr(node, "kept"):
        yield ast.Constant(not node.value)
    elif isinstance(node, ast.IfExp):
        yield ast.IfExp(node.test, node.orelse, node.body)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        swaps = {"abs": None, "any": "all", "all": "any", "min": "max"}
        if node.func.id in swaps:
            name = swaps[node.func.id]
            yield ast.Call(ast.Name(name, ast.Load()), node.args, []) if name else node.args[0]
    elif isinstance(node, ast.If):
        yield ast.If(node.test, [ast.Pass()], node.orelse)
    elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        swaps = {"QUICK_STOP": "PATH_STOP", "PATH_STOP": "NOTE", "NOTE": "PATH_STOP"}
        if node.attr in swaps:
            yield ast.Attribute(node.value, swaps[node.attr], node.ctx)


class _Put(ast.NodeTransformer):
    def __init__(self, place: int, change: int) -> None:
        self._left, self._change = place, change

    def visit(self, node: ast.AST) -> ast.AST:
        self._left -= 1
        if self._left == -1:
            return list(changes(node))[self._change]
        return super().visit(node)


def parsed(source: str) -> ast.Module:
    """The module; named switches (frozen=True, strict=True) decide nothing and are kept."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword):
            node.value.kept = True  # type: ignore[attr-defined]
    return tree


def mutants(source: str) -> Iterator[tuple[str, ast.Module]]:
    """Every changed module with the line and text of the change."""
    for place, node in enumerate(_in_order(parsed(source))):
        for number, changed in enumerate(changes(node)):
            tree = ast.fix_missing_locations(_Put(place, number).visit(parsed(source)))
            was, now = (ast.unparse(n).splitlines()[0] for n in (node, changed))
            yield f"line {getattr(node, 'lineno', 0)}: {was}  ->  {now}", tree


def _in_order(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes in the order in which a transformer visits them."""
    yield node
    for child in ast.iter_child_nodes(node):
        yield from _in_order(child)


def noticed(name: str, tree: ast.Module) -> bool:
    """Whether a test fails with the changed module; in a child process, in limited time."""
    child = os.fork()
    if child == 0:
        signal.alarm(PATIENCE_S)
        os._exit(_tests(name, tree))
    return os.waitpid(child, 0)[1] != 0


def _tests(name: str, tree: ast.Module) -> int:
    module = types.ModuleType(f"executor.safety.{name}")
    sys.modules[module.__name__] = module
    silence = io.StringIO()
    with contextlib.redirect_stdout(silence), contextlib.redirect_stderr(silence):
        try:
            exec(compile(tree, name, "exec"), module.__dict__)
        except (TypeError, ValueError, NameError):
            return 1
        options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-W", "ignore"]
        return int(pytest.main([*options, str(HERE / MODULES[name])]))


def main() -> int:
    """Prints what was missed; 1 when that is too much."""
    os.chdir(ROOT)
    sys.path.insert(0, str(ROOT))
    out = sys.stdout.write
    total, missed = 0, 0
    for name in MODULES:
        source = (ROOT / "executor" / "safety" / f"{name}.py").read_text(encoding="utf-8")
        if noticed(name, ast.parse(source)):
            out(f"{name}: the tests fail without any change\n")
            return 1
        for what, tree in mutants(source):
            total += 1
            if not noticed(name, tree):
                missed += 1
                out(f"{name} {what}\n")
    out(f"{total - missed} of {total} changes noticed ({1 - missed / total:.1%})")
    out(f" with hypothesis {hypothesis.__version__}, numpy {numpy.__version__}\n")
    return int(1 - missed / total < WANTED)


if __name__ == "__main__":
    sys.exit(main())
