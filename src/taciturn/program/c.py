"""Translation of a program to a C99 function for embedded devices that computes one time step.

    static void name(const tac_real *constants, const tac_real *inputs, tac_real *memory, tac_real *outputs)

Each operation is one line, in the order of the program, and rounds once. If the compiler does not fuse operations
(``-ffp-contract=off``), the results are bit-identical to those of ``program.numpy``. All numbers but 0 and 1, tables
and matrices are in one array of constants. A generator of random numbers has words as its memory, and no inputs. The
code calls no mathematical library: bits are copied with ``memcpy``, and the square root is computed digit by digit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from taciturn.program.functions import LAYOUTS
from taciturn.program.ir import Program
from taciturn.program.ops import EIGHT, LITERAL, Op, Precision, needed, tiles

REAL, ROOT, CONSTANTS = "tac_real", "tac_root", "constants"
# by operation: the type of its value, and its expression from its arguments; an empty type is that of the first one
_EXPRESSIONS: Mapping[str, tuple[str, str]] = {
    "add": (REAL, "{0} + {1}"),
    "sub": (REAL, "{0} - {1}"),
    "mul": (REAL, "{0} * {1}"),
    "div": (REAL, "{0} / {1}"),
    "sqrt": (REAL, f"{ROOT}({{0}})"),
    "narrow": (REAL, f"({REAL})(float){{0}}"),
    "select": (REAL, "{0} ? {1} : {2}"),
    "lookup": (REAL, "{0}[(size_t){1}]"),
    "pick": (REAL, f"{{0}}[{{1}} & {EIGHT - 1}u]"),
    "entry": (REAL, "{0}[{1}]"),
    "greater": ("bool", "{0} > {1}"),
    "less_equal": ("bool", "{0} <= {1}"),
    "and": ("bool", "{0} && {1}"),
    "not": ("bool", "!{0}"),
    "word": ("uint64_t", "UINT64_C(0x{0:x})"),
    "half": ("uint32_t", "UINT32_C(0x{0:x})"),
    "word_add": ("", "{0} + {1}"),
    "word_and": ("", "{0} & {1}"),
    "word_or": ("", "{0} | {1}"),
    "word_xor": ("", "{0} ^ {1}"),
    "shift_left": ("", "{0} << {1}"),
    "shift_right": ("", "{0} >> {1}"),
    "upper": ("uint32_t", "(uint32_t)({0} >> 32)"),
    "lower": ("uint32_t", "(uint32_t)({0} & UINT64_C(0xffffffff))"),
    "count": (REAL, f"({REAL}){{0}}"),
    "any_bit": ("bool", "{0} != 0u"),
}
_WIDTHS = {"uint64_t": 64, "uint32_t": 32}
_DIGITS: Mapping[Precision, int] = {"float64": 17, "float32": 9}


def print_c(program: Program, name: str, places: Sequence[int], constants: list[float]) -> str:
    """Write the C source of a program as the function ``static void name(constants, inputs, memory, outputs)``."""
    return _Printer(program, name, places, constants).text()


def print_root(precision: Precision) -> str:
    """Write the C source of ``static tac_real tac_root(x)``, a correctly rounded square root."""
    layout = LAYOUTS[precision]
    word = "uint64_t" if precision == "float64" else "uint32_t"
    return _ROOT.format(
        name=ROOT, real=REAL, word=word, mantissa=layout.mantissa, bias=layout.bias, one=f"({word})1"
    )  # fmt: skip


def c_literal(value: float, precision: Precision) -> str:
    """Write a number as a decimal literal of C99 and C++11, with enough digits to restore its exact value."""
    if precision == "float32":
        value = float(np.float32(value))
    if np.isnan(value):
        return f"({REAL})NAN"
    if np.isinf(value):
        return f"{'-' if value < 0 else ''}({REAL})INFINITY"
    text = f"{value:.{_DIGITS[precision]}g}"
    return text + ("" if set(text) & set(".e") else ".0") + ("f" if precision == "float32" else "")


def constant_array(kind: str, name: str, values: Sequence[str]) -> str:
    """Write the definition of an array of constants in C, with several numbers per line."""
    lines, line = list[str](), ""
    for value in values:
        if line and len(line) + len(value) > 110:
            lines.append(line)
            line = ""
        line += f"{' ' if line else ''}{value},"
    return "\n  ".join([f"static const {kind} {name}[] = {{", *lines, line]) + "\n};\n"


class _Printer:
    """Converts one program to lines of C, and records the types of its values."""

    def __init__(self, program: Program, name: str, places: Sequence[int], constants: list[float]) -> None:
        self.program, self.name, self.places, self.constants = program, name, places, constants
        moved = [op for i, op in enumerate(program.following) if self._moves(i, op)]
        self.live = needed(program.ops, [*moved, *program.outputs.values()])
        self.types: dict[int, str] = {}  # of the operations
        self.names: dict[int, str] = {}  # expressions of values without a variable (constants)
        self.begins: dict[bytes, int] = {}  # places of constants, tables and matrices in the array
        self.words = bool(program.states) and all(state.word for state in program.states)  # a generator of draws

    def text(self) -> str:
        """Return the C source of the function."""
        program = self.program
        lines = [line for i, op in enumerate(program.ops) if i in self.live for line in self._lines(i, op)]
        kept = [(i, op) for i, op in enumerate(program.following) if self._moves(i, op)]
        lines += [f"memory[{i}] = {self._name(op)};" for i, op in kept]
        lines += [f"outputs[{i}] = {self._name(op)};" for i, op in enumerate(program.outputs.values())]
        memory = "uint64_t" if self.words else REAL
        names = ["memory", "outputs"] if self.words else [CONSTANTS, "inputs", "memory", "outputs"]
        unused = [name for name in names if not any(f"{name}[" in line for line in lines)]
        lines += [f"(void){name};" for name in unused]
        given = "" if self.words else f"const {REAL} *{CONSTANTS}, const {REAL} *inputs, "
        head = f"static void {self.name}({given}{memory} *memory, {REAL} *outputs)\n{{"
        return "\n  ".join([head, *lines]) + "\n}\n"

    def _moves(self, state: int, op: int) -> bool:
        """Return whether a step changes the state."""
        return self.program.ops[op] != Op("state", (state,))

    def _name(self, index: int) -> str:
        return self.names.get(index, f"v{index}")

    def _lines(self, index: int, op: Op) -> list[str]:
        if op.name == "product":
            return self._product(index, op)
        if op.name == "bits":
            return self._copied(index, op, "uint64_t" if self.program.precision == "float64" else "uint32_t")
        if op.name == "number":
            return self._copied(index, op, REAL)
        kind, expression = self._expression(op)
        self.types[index] = kind
        if op.name == "const" and CONSTANTS not in expression:
            self.names[index] = expression
            return []
        return [f"const {kind} v{index} = {expression};"]

    def _expression(self, op: Op) -> tuple[str, str]:
        """Return the type and the expression of an operation's value."""
        name, rest = op
        if name == "const":
            return REAL, self._constant(self.program.constants[rest[0]])
        if name == "state":
            return "uint64_t" if self.program.states[rest[0]].word else REAL, f"memory[{rest[0]}]"
        if name == "input":
            return REAL, f"inputs[{self.places[rest[0]]}]"
        literal = LITERAL.get(name)
        given: list[object] = [one if i == literal else self._name(one) for i, one in enumerate(rest)]
        if name in ("lookup", "pick"):
            given[0] = self._stored(self.program.tables[rest[0]])
        if name == "rotate_left":
            kind = self.types[rest[0]]
            return kind, f"({given[0]} << {rest[1]}) | ({given[0]} >> {_WIDTHS[kind] - rest[1]})"
        kind, expression = _EXPRESSIONS[name]
        return kind or self.types[rest[0]], expression.format(*given)

    def _copied(self, index: int, op: Op, kind: str) -> list[str]:
        """Return lines that copy the bits of a value to a variable of another type."""
        self.types[index] = kind
        read = op.arguments[0]
        known = [f"const {REAL} x{index} = {self.names[read]};"] if read in self.names else []
        source = f"x{index}" if known else f"v{read}"
        return [*known, f"{kind} v{index};", f"memcpy(&v{index}, &{source}, sizeof v{index});"]

    def _constant(self, value: float) -> str:
        """Return a number from the array; 0, 1 and the numbers of a generator are written as literals."""
        if value in (0.0, 1.0) or self.words:
            return c_literal(value, self.program.precision)
        negative = self._key([-value]) in self.begins  # the negation is exact, and often costs nothing
        return f"-{CONSTANTS}[{self._place([-value])}]" if negative else f"{CONSTANTS}[{self._place([value])}]"

    def _key(self, values: Sequence[float]) -> bytes:
        return np.array(values, dtype=self.program.precision).tobytes()

    def _stored(self, values: Sequence[float]) -> str:
        """Return a pointer to numbers in the array."""
        return f"({CONSTANTS} + {self._place(values)})"

    def _place(self, values: Sequence[float]) -> int:
        """Return the place of numbers in the array, to which they are added once."""
        place = self.begins.setdefault(self._key(values), len(self.constants))
        if place == len(self.constants):
            self.constants.extend(values)
        return place

    def _product(self, index: int, op: Op) -> list[str]:
        """Return the lines of a matrix product in the order of ``ops.Tile``: tile by tile, column by column, from 0."""
        matrix, parts = self.program.matrices[op.arguments[0]], tiles(self.program.matrices[op.arguments[0]])
        held = [
            matrix[row][j]
            for tile in parts
            for j in range(tile.begin, tile.end)
            for row in range(tile.first, tile.first + tile.rows)
        ]
        name = self._stored(held)
        values = ", ".join(f"{self._name(value)}" for value in op.reads)
        lines = [f"const {REAL} x{index}[] = {{{values}}};", f"{REAL} v{index}[{len(matrix)}] = {{0}};"]
        before = 0
        for first, rows, begin, end in parts:
            lines += [
                f"for (size_t j = 0; j < {end - begin}u; ++j) {{",
                f"  for (size_t i = 0; i < {rows}u; ++i) {{",
                f"    v{index}[i + {first}u] += {name}[{before}u + j * {rows}u + i] * x{index}[j + {begin}u];",
                "  }",
                "}",
            ]
            before += rows * (end - begin)
        return lines


_ROOT = """/* The square root, rounded to nearest, without a library: one binary digit per iteration. */
static {real} {name}({real} x)
{{
  const {word} leading = {one} << {mantissa};
  {word} bits, rest, half, root = 0, found = 0;
  int32_t exponent;
  if (!(x > 0) || x + x == x) {{
    return x < 0 ? (x - x) / (x - x) : x;
  }}
  memcpy(&bits, &x, sizeof bits);
  exponent = (int32_t)(bits >> {mantissa});
  rest = bits & (leading - 1u);
  if (exponent == 0) {{
    for (exponent = 1; rest < leading; --exponent) {{
      rest <<= 1;
    }}
  }}
  rest |= leading;
  exponent -= {bias};
  if (exponent % 2 != 0) {{
    rest <<= 1;
    --exponent;
  }}
  rest <<= 1;
  for (half = leading << 1; half != 0; half >>= 1) {{
    if (found + half <= rest) {{
      rest -= found + half;
      found += half << 1;
      root += half;
    }}
    rest <<= 1;
  }}
  root = ((root + (root & 1u)) >> 1) - leading;
  bits = (({word})(exponent / 2 + {bias}) << {mantissa}) + root;
  memcpy(&x, &bits, sizeof x);
  return x;
}}
"""
