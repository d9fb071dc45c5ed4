"""Changes of one expression or statement of Python code, for ``mutants.py``."""

from __future__ import annotations

import ast
import random
import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from zlib import crc32

ROOT = Path(__file__).resolve().parent.parent

_COMPARISONS = {
    ast.Lt: ("<", "<=", ">="),
    ast.LtE: ("<=", "<", ">"),
    ast.Gt: (">", ">=", "<="),
    ast.GtE: (">=", ">", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
}
_OPERATORS = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "%"),
    ast.Mod: ("%", "//"),
    ast.BitAnd: ("&", "|"),
    ast.BitOr: ("|", "&"),
    ast.BitXor: ("^", "|"),
    ast.LShift: ("<<", ">>"),
    ast.RShift: (">>", "<<"),
    ast.MatMult: ("@", "*"),
}
_NAMES = {
    "minimum": "maximum",
    "min": "max",
    "argmin": "argmax",
    "floor": "ceil",
    "any": "all",
    "zeros": "ones",
    "nanmin": "nanmax",
    "union1d": "intersect1d",
    "flatnonzero": "argsort",
}
_NAMES |= {there: here for here, there in _NAMES.items() if here != "flatnonzero"}
#: Calls of these mean the same with their arguments swapped.
_SYMMETRIC = {"minimum", "maximum", "min", "max", "hypot", "absdiff", "array_equal", "union1d", "intersect1d"}
_WORDS = {"left": "right", "right": "left"}


@dataclass(frozen=True)
class Mutant:
    """Bytes ``start`` to ``end`` of a file, replaced by ``new``.

    ``statement`` holds the first and the last line of the statement that they are in, and ``function`` those of the
    function; zeros outside of functions.
    """

    path: str
    line: int
    kind: str
    start: int
    end: int
    new: bytes
    statement: tuple[int, int]
    function: tuple[int, int]

    @property
    def name(self) -> str:
        return f"{self.path}:{self.line}:{self.start}:{self.kind}:{crc32(self.new):x}"

    def applied(self, source: bytes) -> bytes:
        return source[: self.start] + self.new + source[self.end :]


def _lines_of(statement: ast.stmt) -> tuple[int, int]:
    """The first and the last line of a statement, without those that stand in it."""
    inner = getattr(statement, "body", None)
    return statement.lineno, max(statement.lineno, inner[0].lineno - 1) if inner else statement.end_lineno


class _Finder:
    """All mutants of one file."""

    def __init__(self, path: str, source: bytes) -> None:
        self.path, self.source = path, source
        self.found: list[Mutant] = []
        lines = source.splitlines(keepends=True)
        self._offsets = [0]
        for line in lines:
            self._offsets.append(self._offsets[-1] + len(line))
        self._statement, self._function = (0, 0), (0, 0)
        self._visit(ast.parse(source))

    def _span(self, node: ast.AST) -> tuple[int, int]:
        start = self._offsets[node.lineno - 1] + node.col_offset
        return start, self._offsets[node.end_lineno - 1] + node.end_col_offset

    def _add(self, node: ast.AST, kind: str, span: tuple[int, int], new: str | bytes) -> None:
        data = new.encode() if isinstance(new, str) else new
        if self.source[span[0] : span[1]] != data:
            where = self._statement, self._function
            self.found.append(Mutant(self.path, node.lineno, kind, *span, data, *where))

    def _token(self, node: ast.AST, kind: str, low: ast.AST, high: ast.AST, old: str, new: str) -> None:
        """The operator between two nodes."""
        start, end = self._span(low)[1], self._span(high)[0]
        words = re.escape(old).replace(r"\ ", r"\s+")
        match = re.search(words.encode(), self.source[start:end])
        if match:
            self._add(node, kind, (start + match.start(), start + match.end()), new)

    def _visit(self, node: ast.AST) -> None:
        if isinstance(node, (ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom)):
            return
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            return
        if isinstance(node, ast.keyword) and node.arg == "strict":  # of zip(): a safeguard that never acts
            return
        before = self._statement, self._function
        if isinstance(node, ast.stmt):
            self._statement = _lines_of(node)
        if isinstance(node, ast.FunctionDef):
            self._function = node.lineno, node.end_lineno
        self._mutate(node)
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list"):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    self._visit(child)
        if isinstance(node, (ast.FunctionDef, ast.For, ast.While, ast.If, ast.With, ast.Try)):
            for body in (getattr(node, part, []) for part in ("body", "orelse", "finalbody")):
                self._delete(body)
        self._statement, self._function = before

    def _delete(self, body: list[ast.stmt]) -> None:
        for statement in body:
            doc = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
            stores = isinstance(statement, ast.Assign) and not isinstance(statement.targets[0], (ast.Name, ast.Tuple))
            kinds = (ast.Expr, ast.AugAssign, ast.If, ast.Continue, ast.Break, ast.For)
            self._statement = _lines_of(statement)
            if (isinstance(statement, kinds) and not doc) or stores:
                self._add(statement, "deleted", self._span(statement), "pass")

    def _mutate(self, node: ast.AST) -> None:
        match node:
            case ast.Compare(left=left, ops=ops, comparators=others):
                for low, op, high in zip([left, *others], ops, others, strict=False):
                    old, *new = _COMPARISONS[type(op)]
                    for one in new:
                        self._token(node, "compared", low, high, old, one)
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                text = f"({ast.unparse(left)} * {ast.unparse(right)})"
                self._add(node, "operator", self._span(node), text)
            case ast.BinOp(left=left, op=op, right=right):
                self._token(node, "operator", left, right, *_OPERATORS[type(op)])
            case ast.AugAssign(target=target, op=op, value=value) if type(op) in _OPERATORS:
                self._token(node, "operator", target, value, *_OPERATORS[type(op)])
            case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert(), operand=operand):
                self._add(node, "unary", self._span(node), f"({ast.unparse(operand)})")
            case ast.BoolOp(op=op, values=values):
                other = ast.BoolOp(ast.Or() if isinstance(op, ast.And) else ast.And(), values)
                self._add(node, "and/or", self._span(node), f"({ast.unparse(other)})")
            case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test):
                self._add(test, "negated", self._span(test), f"(not ({ast.unparse(test)}))")
            case ast.Call(func=func, args=args) if ast.unparse(func).rpartition(".")[2] not in _SYMMETRIC:
                for one, two in pairwise(args):
                    if not isinstance(one, ast.Starred) and not isinstance(two, ast.Starred):
                        (a, b), (c, d) = self._span(one), self._span(two)
                        self._add(one, "swapped", (a, d), self.source[c:d] + self.source[b:c] + self.source[a:b])
            case ast.Attribute(value=value, attr=attr) if attr in _NAMES:
                end = self._span(node)[1]
                self._add(value, "name", (end - len(attr), end), _NAMES[attr])
            case ast.Name(id=name) if name in _NAMES and isinstance(node.ctx, ast.Load):
                self._add(node, "name", self._span(node), _NAMES[name])
            case ast.Constant(value=bool(value)):
                self._add(node, "constant", self._span(node), str(not value))
            case ast.Constant(value=int(value) | float(value)):
                for new in (value + 1, value - 1):
                    self._add(node, "constant", self._span(node), f"({new})" if new < 0 else repr(new))
            case ast.Constant(value=str(value)) if value in _WORDS:
                self._add(node, "word", self._span(node), repr(_WORDS[value]))


def mutants_of(path: str, source: bytes) -> list[Mutant]:
    """All mutants of this source, which stands at ``path``."""
    return _Finder(path, source).found


def find(places: list[str]) -> list[Mutant]:
    """All mutants of these files and folders, relative to the root of the project."""
    paths = [ROOT / place for place in places]
    files = [file for path in paths for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])]
    return [mutant for file in files for mutant in mutants_of(file.relative_to(ROOT).as_posix(), file.read_bytes())]


def sample(mutants: list[Mutant], count: int, seed: int) -> list[Mutant]:
    """So many of them, at most one for each place of the code."""
    chosen = random.Random(seed).sample(mutants, len(mutants))
    places: dict[tuple[str, int], Mutant] = {}
    for mutant in chosen:
        places.setdefault((mutant.path, mutant.start), mutant)
    return sorted(list(places.values())[:count], key=lambda m: (m.path, m.start))
