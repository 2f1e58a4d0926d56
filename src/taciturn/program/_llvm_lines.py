"""Generation of LLVM IR for vectors: single instructions, access to memory, and table lookups.

``CodeLines`` collects lines of LLVM IR. Each value is a vector with one lane per path. Constants, tables and matrices
are in one array in memory, so that programs that differ only in their numbers share machine code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from taciturn.program.ir import Program
from taciturn.program.ops import EIGHT, MatrixRows, Precision, Tile, tiles
from taciturn.program.target import Target

# The function and the types of numbers and positions, by the number of doubles that one instruction permutes. AVX2 has
# no permutation of doubles by computed positions; the permutation of their halves, as floats, replaces it.
PERMUTES = {
    8: ("llvm.x86.avx512.permvar.df.512", "<8 x double>", "<8 x i64>"),
    4: ("llvm.x86.avx2.permps", "<8 x float>", "<8 x i32>"),
}
_NUMBER: Mapping[Precision, tuple[str, int]] = {"float64": ("double", 64), "float32": ("float", 32)}


def constants_of(program: Program) -> list[float]:
    """Return all constants of a program in the order in which the machine code reads them.

    These are the constants, the tables, and the tiles of the matrices column by column.
    """
    tables = (value for table in program.tables for value in table)
    matrices = (value for matrix in program.matrices for tile in tiles(matrix) for value in tile_columns(matrix, tile))
    return [*program.constants, *tables, *matrices]


def tile_columns(matrix: MatrixRows, tile: Tile) -> list[float]:
    """Return the coefficients of a tile (block) of a matrix, column by column."""
    return [row[j] for j in range(tile.begin, tile.end) for row in matrix[tile.first : tile.first + tile.rows]]


def filled_lanes(kind: str, literal: object, lanes: int) -> str:
    """Return an LLVM vector constant with the same number in every lane."""
    return "<" + ", ".join([f"{kind} {literal}"] * lanes) + ">"


class CodeLines:
    """Lines of LLVM IR for a program, and the types and addresses that they use.

    Args:
        program: the program to translate.
        target: the processor.
        lanes: number of paths per vector.
        own: whether each lane has its own constants.
    """

    def __init__(self, program: Program, target: Target, lanes: int, own: bool) -> None:
        """Start without lines."""
        self.program, self.lanes, self.own = program, lanes, own
        self.number, self.bits = _NUMBER[program.precision]
        self.numbers, self.doubles, self.truths = (f"<{lanes} x {kind}>" for kind in (self.number, "double", "i1"))
        self.words, self.halves = f"<{lanes} x i64>", f"<{lanes} x i32>"
        wide = target.permutes
        self.permutes = wide if wide and program.precision == "float64" and not own and lanes % wide == 0 else 0
        self.number_at = "double" if own else self.number  # type of the constants in memory
        self.entries = f"<{lanes} x {self.number_at}>"
        self.gather = f"llvm.masked.gather.v{lanes}f{64 if self.number_at == 'double' else 32}.v{lanes}p0"
        self.lines: list[str] = []
        self.base = ""  # address of the constants
        self.counter = 0

    def _new(self, text: str) -> str:
        self.counter += 1
        name = f"%v{self.counter}"
        self.lines.append(f"  {name} = {text}")
        return name

    def _every(self, kind: str, literal: str) -> str:
        return filled_lanes(kind, literal, self.lanes)

    def _splat(self, scalar: str, kind: str) -> str:
        """Return a vector with a scalar in every lane."""
        vector = f"<{self.lanes} x {kind}>"
        one = self._new(f"insertelement {vector} poison, {kind} {scalar}, i32 0")
        return self._new(f"shufflevector {vector} {one}, {vector} poison, <{self.lanes} x i32> zeroinitializer")

    def _load(self, address: str) -> str:
        """Load numbers that are stored as doubles."""
        return self._narrow(self._new(f"load {self.doubles}, ptr {address}, align 8"))

    def _narrow(self, doubles: str) -> str:
        if self.number == "double":
            return doubles
        return self._new(f"fptrunc {self.doubles} {doubles} to {self.numbers}")

    def _widen(self, numbers: str) -> str:
        """Return numbers converted to doubles."""
        return numbers if self.number == "double" else self._new(f"fpext {self.numbers} {numbers} to {self.doubles}")

    def _row(self, base: str, first: str, index: int) -> str:
        """Return the address of row ``first + index`` in an array of vectors of doubles."""
        row = self._new(f"add i64 {first}, {index}")
        offset = self._new(f"mul i64 {row}, {self.lanes}")
        return self._new(f"getelementptr double, ptr {base}, i64 {offset}")

    def _address(self, base: str, index: int | str) -> str:
        """Return the address of a constant; with constants per lane, the address of that of the first lane."""
        if self.own:
            index = self._new(f"mul i64 {index}, {self.lanes}")
        return self._new(f"getelementptr {self.number_at}, ptr {base}, i64 {index}")

    def _coefficient(self, index: int | str, base: str | None = None) -> str:
        """Return a constant as a vector, given its position relative to an address."""
        address = self._address(base or self.base, index)
        if self.own:
            return self._load(address)
        return self._splat(self._new(f"load {self.number}, ptr {address}, align 4"), self.number)

    def _table(self, table: int) -> str:
        """Return the address of a table."""
        before = len(self.program.constants) + sum(len(values) for values in self.program.tables[:table])
        start = "%constants" if not self.own else self.base
        places = before * (self.lanes if self.own else 1)
        return self._new(f"getelementptr {self.number_at}, ptr {start}, i64 {places}")

    def _permuted(self, base: str, words: str) -> str:
        """Return the entries of a table at the last three bits of words, as many as one instruction permutes."""
        wide = self.permutes
        U, V = f"<{wide} x i64>", f"<{wide} x double>"
        function, numbers, places = PERMUTES[wide]
        if wide == EIGHT:
            entries = self._new(f"load {V}, ptr {base}, align 8")
            return self._new(f"call {V} @{function}({V} {entries}, {U} {words})")
        # AVX2 permutes eight floats. Entry k of four doubles is the pair of floats 2k and 2k + 1, so position k becomes
        # the pair (2k, 2k + 1). Both halves of the table are permuted by the last two bits; the third bit selects one.
        twice = self._new(f"shl {U} {words}, {filled_lanes('i64', 1, wide)}")
        parts = self._new(f"bitcast {U} {twice} to {places}")
        evens = ", ".join(f"i32 {2 * (k // 2)}" for k in range(8))
        pairs = self._new(f"shufflevector {places} {parts}, {places} poison, {places} <{evens}>")
        odds = ", ".join(f"i32 {k % 2}" for k in range(8))
        chosen = self._new(f"or {places} {pairs}, <{odds}>")
        halves: list[str] = []
        for first in (0, 4):
            address = self._new(f"getelementptr double, ptr {base}, i64 {first}")
            entries = self._new(f"load {numbers}, ptr {address}, align 8")
            found = self._new(f"call {numbers} @{function}({numbers} {entries}, {places} {chosen})")
            halves.append(self._new(f"bitcast {numbers} {found} to {V}"))
        # bit 2 is shifted to bit 63, the sign
        sign = self._new(f"shl {U} {words}, {filled_lanes('i64', 61, wide)}")
        upper = self._new(f"icmp slt {U} {sign}, zeroinitializer")
        return self._new(f"select <{wide} x i1> {upper}, {V} {halves[1]}, {V} {halves[0]}")

    def _gathered(self, base: str, kind: str, offsets: str) -> str:
        # with constants per lane, entry k of lane i is at position k·lanes + i
        if self.own:
            element = "i32" if kind == self.halves else "i64"
            lanes = "<" + ", ".join(f"{element} {lane}" for lane in range(self.lanes)) + ">"
            scaled = self._new(f"mul {kind} {offsets}, {self._every(element, str(self.lanes))}")
            offsets = self._new(f"add {kind} {scaled}, {lanes}")
        addresses = self._new(f"getelementptr {self.number_at}, ptr {base}, {kind} {offsets}")
        found = self._new(
            f"call {self.entries} @{self.gather}(<{self.lanes} x ptr> {addresses}, i32 4, "
            f"{self.truths} {self._every('i1', 'true')}, {self.entries} zeroinitializer)"
        )
        return self._narrow(found) if self.number_at == "double" else found

    def _part(self, name: str, kind: str, lanes: range, narrower: str) -> str:
        """Return some lanes of a vector of type ``kind``, as a vector of type ``narrower``."""
        if kind == narrower:
            return name
        chosen = ", ".join(f"i32 {lane}" for lane in lanes)
        return self._new(f"shufflevector {kind} {name}, {kind} poison, <{len(lanes)} x i32> <{chosen}>")

    def _joined(self, parts: Sequence[str]) -> str:
        """Return the concatenation of vectors of doubles, in pairwise steps."""
        width = self.lanes // len(parts)
        while len(parts) > 1:
            kind, chosen = f"<{width} x double>", ", ".join(f"i32 {lane}" for lane in range(2 * width))
            width *= 2
            parts = [
                self._new(f"shufflevector {kind} {one}, {kind} {other}, <{width} x i32> <{chosen}>")
                for one, other in zip(parts[::2], parts[1::2], strict=True)
            ]
        return parts[0]
