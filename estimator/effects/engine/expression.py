"""From a user's expression to a compiled law, safely: only whitelisted syntax is ever turned into code.

The text is parsed with `ast`, every node is checked against the lists below and rewritten (parameters become p[0],
p[1], ...; numpy names become scalar code), and only the rewritten tree is compiled. There is no attribute access, no
subscript, no string, no call of anything that is not in FUNCTION_CODES.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import njit

from estimator.errors import ModelError

STATE_NAMES = ("x", "v", "xo", "vo", "t", "phase")
NUMBER_CONSTANTS = {"pi": math.pi, "e": math.e}
MAX_LENGTH_CHARACTERS, MAX_NODE_COUNT, MAX_DEPTH_LEVELS = 1000, 300, 40

OWN_FUNCTIONS: dict[str, Callable[..., Any]] = {  # of numpy, for scalars
    "power": lambda a, b: a**b,
    "square": lambda a: a * a,
    "sign": lambda a: 1.0 if a > 0.0 else (-1.0 if a < 0.0 else 0.0 * a),
    "heaviside": lambda a, at_zero: 1.0 if a > 0.0 else (0.0 if a < 0.0 else at_zero),
    "clip": lambda a, low, high: min(max(a, low), high),
    "where": lambda condition, a, b: a if condition else b,
}
SCALAR_FUNCTIONS = {f"_{name}": njit(error_model="numpy")(function) for name, function in OWN_FUNCTIONS.items()}
FUNCTION_CODES: dict[str, tuple[int, str]] = {  # name -> number of arguments, scalar code
    **{
        name: (1, f"math.{name}")
        for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "expm1", "log", "log1p", "log10")
    },
    **{name: (1, f"math.{name}") for name in ("sqrt", "floor", "ceil")},
    **{name: (1, f"math.{name.replace('arc', 'a')}") for name in ("arcsin", "arccos", "arctan")},
    "arctan2": (2, "math.atan2"),
    "hypot": (2, "math.hypot"),
    "fmod": (2, "math.fmod"),
    **dict.fromkeys(("abs", "absolute", "fabs"), (1, "abs")),
    "maximum": (2, "max"),
    "minimum": (2, "min"),
    **{name: (function.__code__.co_argcount, f"_{name}") for name, function in OWN_FUNCTIONS.items()},
}
OPERATOR_NODES = (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow, ast.Mod, ast.FloorDiv)
COMPARISON_NODES = (ast.Lt, ast.LtE, ast.Gt, ast.GtE, ast.Eq, ast.NotEq)

OPERATOR_SIGNS = {
    "BitXor": "^",
    "BitAnd": "&",
    "BitOr": "|",
    "LShift": "<<",
    "RShift": ">>",
    "MatMult": "@",
    "Invert": "~",
}


class ExpressionError(ModelError):
    """An expression is wrong. The message says how.

    Parameters
    ----------
    text : str
        What is wrong, one line.
    column : int
        Where, counted from 1.
    parameter : str
        Name of the parameter that is wrong; "" where it is the expression itself.
    """

    def __init__(self, text: str, column: int, parameter: str = "") -> None:
        super().__init__(text if parameter else f"{text} (column {column})")
        self.column = column
        self.parameter = parameter


class _Rewrite(ast.NodeTransformer):
    """Checks every node and turns names into scalar code; `used` collects the names that occur."""

    def __init__(self, parameters: tuple[str, ...]) -> None:
        self.parameters = parameters
        self.used: set[str] = set()

    def generic_visit(self, node: ast.AST) -> ast.AST:
        allowed = (
            ast.Expression, ast.BinOp, ast.UnaryOp, ast.BoolOp, ast.Compare, ast.IfExp, ast.UAdd, ast.USub, ast.Not,
            ast.And, ast.Or, *OPERATOR_NODES, *COMPARISON_NODES,
        )  # fmt: skip
        if not isinstance(node, allowed):
            raise ExpressionError(
                f"{_describe(node)} is not allowed in an expression", getattr(node, "col_offset", 0) + 1
            )
        return super().generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        if not isinstance(node.op, OPERATOR_NODES):
            at = (node.left.end_col_offset or node.left.col_offset) + 1
            remedy = "; a power is **" if isinstance(node.op, ast.BitXor) else ""
            raise ExpressionError(f"operator {_describe(node.op)} is not allowed{remedy}", at)
        small = isinstance(node.right, ast.Constant) and type(node.right.value) is int and abs(node.right.value) <= 16
        if isinstance(node.op, ast.Pow) and small:  # a whole power stays whole: exact for negative x, and fast
            node.left = self.visit(node.left)
            return node
        return self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        if isinstance(node.value, bool) or not isinstance(node.value, (int, float)):
            raise ExpressionError(f"{node.value!r} is not a number", node.col_offset + 1)
        try:
            value = float(node.value)
        except OverflowError:
            value = math.inf
        if not math.isfinite(value):
            raise ExpressionError("the number is too large", node.col_offset + 1)
        return ast.copy_location(ast.Constant(value), node)

    def visit_Name(self, node: ast.Name) -> ast.AST:
        self.used.add(node.id)
        if node.id in self.parameters:
            return ast.parse(f"p[{self.parameters.index(node.id)}]", mode="eval").body
        if node.id in STATE_NAMES:
            return node
        if node.id in NUMBER_CONSTANTS:
            return ast.copy_location(ast.Constant(NUMBER_CONSTANTS[node.id]), node)
        if node.id in FUNCTION_CODES:
            raise ExpressionError(f"{node.id} is a function: {node.id}(...)", node.col_offset + 1)
        known = ", ".join((*STATE_NAMES, *self.parameters))
        raise ExpressionError(f'unknown name "{node.id}"; there are {known} and numpy functions', node.col_offset + 1)

    def visit_Call(self, node: ast.Call) -> ast.AST:
        if isinstance(node.func, ast.Attribute) and node.func.attr in FUNCTION_CODES:
            name = node.func.attr
            raise ExpressionError(f"write {name}(...), without a module before it", node.col_offset + 1)
        if not isinstance(node.func, ast.Name) or node.func.id not in FUNCTION_CODES:
            what = f'"{node.func.id}"' if isinstance(node.func, ast.Name) else "this"
            known = ", ".join(sorted(FUNCTION_CODES))
            raise ExpressionError(f"{what} is not one of the functions: {known}", node.col_offset + 1)
        count, code = FUNCTION_CODES[node.func.id]
        if node.keywords or len(node.args) != count:
            raise ExpressionError(
                f"{node.func.id} takes {count} argument(s), {len(node.args)} given", node.col_offset + 1
            )
        func = ast.parse(code, mode="eval").body
        return ast.copy_location(ast.Call(func, [self.visit(a) for a in node.args], []), node)


def _describe(node: ast.AST) -> str:
    words = {
        ast.Attribute: "an attribute (.)",
        ast.Subscript: "an index [ ]",
        ast.Lambda: "lambda",
        ast.Tuple: "a tuple",
        ast.List: "a list",
        ast.ListComp: "a list",
        ast.NamedExpr: "an assignment (:=)",
        ast.JoinedStr: "a text",
    }
    return words.get(type(node)) or OPERATOR_SIGNS.get(type(node).__name__, f"this ({type(node).__name__})")


def _depth(node: ast.AST) -> int:
    deepest, level = 0, [node]
    while level:
        deepest += 1
        level = [child for parent in level for child in ast.iter_child_nodes(parent)]
    return deepest


@cache
def compile_law(expression: str, parameters: tuple[str, ...]) -> tuple[Callable[..., float], frozenset[str]]:
    """The force function of an expression. Nothing of the text is executed but the whitelisted arithmetic.

    Parameters
    ----------
    expression : str
        Force in N by x, v, xo, vo, t, phase, the parameters and numpy's functions by their plain names.
    parameters : tuple of str
        Their names, in the order of p.

    Returns
    -------
    callable
        force(x, v, xo, vo, t, phase, s, p) -> N, one object for one text.
    frozenset of str
        The names that the expression uses.

    Raises
    ------
    ExpressionError
        What is wrong, and its column from 1.
    """
    for name in parameters:
        if not name.isidentifier() or name in STATE_NAMES or name in FUNCTION_CODES or name in NUMBER_CONSTANTS:
            raise ExpressionError(f'a parameter cannot be called "{name}"; rename it', 1, name)
    text = expression.replace("\n", " ")
    lead = len(text) - len(text.lstrip())
    if not text.strip():
        raise ExpressionError("the expression is empty", 1)
    if len(text) > MAX_LENGTH_CHARACTERS:
        raise ExpressionError(
            f"the expression is longer than {MAX_LENGTH_CHARACTERS} characters", MAX_LENGTH_CHARACTERS + 1
        )
    try:
        tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        ends = not getattr(error, "offset", None) or getattr(error, "lineno", 1) != 1
        column = len(text.strip()) + 1 if ends else int(getattr(error, "offset", 1))
        raise ExpressionError(f"not an expression: {getattr(error, 'msg', error)}", column + lead) from None
    if sum(1 for _ in ast.walk(tree)) > MAX_NODE_COUNT or _depth(tree) > MAX_DEPTH_LEVELS:
        raise ExpressionError(
            f"the expression is too involved (over {MAX_NODE_COUNT} terms or {MAX_DEPTH_LEVELS} levels)", 1
        )
    rewrite = _Rewrite(parameters)
    try:
        body = ast.unparse(ast.fix_missing_locations(rewrite.visit(tree)))
    except ExpressionError as error:  # none of a parameter
        raise ExpressionError(str(error).rsplit(" (column", 1)[0], error.column + lead) from None
    unused = [name for name in parameters if name not in rewrite.used]
    if unused:
        raise ExpressionError("the expression does not use it; write it there, or remove it", 1, unused[0])
    if not rewrite.used & set(STATE_NAMES):
        raise ExpressionError(f"the law uses none of {', '.join(STATE_NAMES)}: it would be a constant", 1)
    namespace: dict[str, object] = {"math": math, **SCALAR_FUNCTIONS}
    source = f"def force(x, v, xo, vo, t, phase, s, p):\n    return float({body})\n"
    exec(compile(source, f"<law {text.strip()}>", "exec"), namespace)
    law = namespace["force"]
    if not callable(law):
        raise TypeError("force")
    return law, frozenset(rewrite.used)
