"""All small changes of a module: limits by one, comparisons, signs, missing statements. Pure.

Annotations, docstrings, texts and named switches (``frozen=True``) are not changed, as they decide
nothing at run time. Idea: opendbc's ``safety/tests/mutation.py``.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import CodeType

COMPARED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
COMPUTED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}
CALLED = {"any": "all", "all": "any", "min": "max", "max": "min", "ceil": "floor", "floor": "ceil"}
NAMED = {"QUICK_STOP": "PATH_STOP", "PATH_STOP": "NOTE", "NOTE": "PATH_STOP"}
LONGEST = 100
SWITCHES = {"frozen", "slots", "strict", "eq", "exist_ok", "parents"}


@dataclass(frozen=True)
class Mutant:
    """One change of one module.

    Attributes:
        line: Line number from 1.
        scope: Enclosing function or class, dotted; empty for the module.
        was: First line of the statement by `ast.unparse`.
        now: The same after the change.
        code: The changed module, compiled.
    """

    line: int
    scope: str
    was: str
    now: str
    code: CodeType


@dataclass(frozen=True)
class _Spot:
    """A node, its statement and scope, and a function that replaces it."""

    node: ast.AST
    statement: ast.stmt | None
    scope: str
    put: Callable[[ast.AST], None]


def mutants(source: str, path: str) -> list[Mutant]:
    """All mutants of a module, in the order of the lines."""
    tree = ast.parse(source)
    return [
        _mutant(tree, spot, changed, path)
        for spot in list(_spots(tree, None, ""))
        for changed in _changes(spot.node)
    ]


def _mutant(tree: ast.Module, spot: _Spot, changed: ast.AST, path: str) -> Mutant:
    assert spot.statement is not None
    was = _text(spot.statement, spot.node)
    spot.put(ast.fix_missing_locations(ast.copy_location(changed, spot.node)))
    statement = changed if spot.node is spot.statement else spot.statement
    now, code = _text(statement, changed), compile(tree, path, "exec")
    spot.put(spot.node)
    line = getattr(spot.node, "lineno", spot.statement.lineno)
    return Mutant(line, spot.scope, was, now, code)


def _text(statement: ast.AST, node: ast.AST) -> str:
    """The statement's first line if it is short, else only the changed node."""
    lines = ast.unparse(statement).splitlines()
    head = lines[0] if isinstance(statement, ast.If | ast.While | ast.For) else " ".join(lines)
    is_part = node is not statement
    if is_part and (len(head) > LONGEST or isinstance(statement, ast.ClassDef | ast.FunctionDef)):
        return ast.unparse(node)
    return head


def _spots(node: ast.AST, statement: ast.stmt | None, scope: str) -> Iterator[_Spot]:
    """All nodes below one, except those that decide nothing."""
    inner = scope
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        inner = f"{scope}.{node.name}".lstrip(".")
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "type_params") or _is_switch(node):
            continue
        if isinstance(value, ast.AST):
            yield from _spot(value, statement, inner, _putter(node, name, None))
        elif isinstance(value, list):
            for index, item in enumerate(value):
                if isinstance(item, ast.AST) and not _is_text(item):
                    yield from _spot(item, statement, inner, _putter(node, name, index))


def _spot(
    node: ast.AST, statement: ast.stmt | None, scope: str, put: Callable[[ast.AST], None]
) -> Iterator[_Spot]:
    own = node if isinstance(node, ast.stmt) else statement
    if own is not None:
        yield _Spot(node, own, scope, put)
    yield from _spots(node, own, scope)


def _putter(parent: ast.AST, name: str, index: int | None) -> Callable[[ast.AST], None]:
    def put(node: ast.AST) -> None:
        if index is None:
            setattr(parent, name, node)
        else:
            getattr(parent, name)[index] = node

    return put


def _is_switch(node: ast.AST) -> bool:
    return isinstance(node, ast.keyword) and node.arg in SWITCHES


def _is_text(node: ast.AST) -> bool:
    """Whether a node is a docstring, a string that describes an attribute, or an ellipsis."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _changes(node: ast.AST) -> Iterator[ast.AST]:
    """All small changes of one node."""
    if isinstance(node, ast.Compare):
        for index, operator in enumerate(node.ops):
            for other in COMPARED.get(type(operator), ()):
                ops = [other() if k == index else op for k, op in enumerate(node.ops)]
                yield ast.Compare(node.left, ops, node.comparators)
    elif isinstance(node, ast.BoolOp):
        yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
        yield from _without_one(node.values, lambda left: ast.BoolOp(node.op, left))
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        yield node.operand
    elif isinstance(node, ast.BinOp) and type(node.op) in COMPUTED:
        yield ast.BinOp(node.left, COMPUTED[type(node.op)](), node.right)
    elif isinstance(node, ast.AugAssign) and type(node.op) in COMPUTED:
        yield ast.AugAssign(node.target, COMPUTED[type(node.op)](), node.value)
    elif isinstance(node, ast.Constant):
        yield from _other_values(node.value)
    elif isinstance(node, ast.IfExp):
        yield ast.IfExp(node.test, node.orelse, node.body)
    elif isinstance(node, ast.Set) and len(node.elts) > 1:
        for index in range(len(node.elts)):
            yield ast.Set([e for k, e in enumerate(node.elts) if k != index])
    elif isinstance(node, ast.Call):
        yield from _other_calls(node)
    elif isinstance(node, ast.If):
        yield ast.If(node.test, [ast.Pass()], node.orelse)
    elif isinstance(node, ast.Raise | ast.Expr):
        yield ast.Pass()
    elif isinstance(node, ast.Attribute) and node.attr in NAMED:
        yield ast.Attribute(node.value, NAMED[node.attr], node.ctx)


def _other_values(value: object) -> Iterator[ast.AST]:
    if type(value) is bool:
        yield ast.Constant(not value)
    elif type(value) in (int, float):
        assert isinstance(value, int | float)
        yield ast.Constant(value + 1)
        yield ast.Constant(value - 1)


def _other_calls(call: ast.Call) -> Iterator[ast.AST]:
    function = call.func
    name = function.id if isinstance(function, ast.Name) else getattr(function, "attr", "")
    if name == "abs":
        yield call.args[0]
    elif name in CALLED and isinstance(function, ast.Name):
        yield ast.Call(ast.Name(CALLED[name], ast.Load()), call.args, call.keywords)
    elif name in CALLED and isinstance(function, ast.Attribute):
        other = ast.Attribute(function.value, CALLED[name], function.ctx)
        yield ast.Call(other, call.args, call.keywords)


def _without_one(
    values: list[ast.expr], made: Callable[[list[ast.expr]], ast.expr]
) -> Iterator[ast.expr]:
    for index in range(len(values)):
        left = [value for k, value in enumerate(values) if k != index]
        yield made(left) if len(left) > 1 else left[0]
