"""What a program is printed for: a processor, and what its vectors can do.

The number of lanes is free: any program can be printed with any for any processor. What differs with the processor is
the instruction that looks into small tables. LLVM ends the whole process where a text asks for an instruction that the
features of its function lack, so the text carries the features that it was printed for, and is compiled for these.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from taciturn.errors import ProblemError

VECTORS = "TACITURN_VECTORS"


@dataclass(frozen=True)
class Target:
    """A processor as LLVM describes it.

    Args:
        triple: architecture, vendor, system.
        cpu: name of the processor; empty: any of the architecture.
        features: what it has beyond that, as LLVM writes it: ``"+avx2,-avx512f"``. What the name implies but is not
            listed here is compiled for, and not printed for.
    """

    triple: str
    cpu: str
    features: str

    @property
    def permutes(self) -> int:
        """How many doubles one instruction permutes by places known at run time: 8 (AVX-512), 4 (AVX2) or 0."""
        if self.triple.partition("-")[0] not in ("x86_64", "amd64", "i686", "i386"):
            return 0
        return 8 if self._has("avx512f") else 4 if self._has("avx2") else 0

    @property
    def lanes(self) -> int:
        """How many doubles its widest vector holds; two where nothing else is known: SSE2 and NEON."""
        return self.permutes or 2

    @property
    def heading(self) -> str:
        """The lines that begin a module for this processor."""
        lines = [f'target triple = "{self.triple}"']
        if "windows" in self.triple:
            lines.append("@_fltused = global i32 0")  # code with floating-point numbers refers to it; nobody reads it
        return "\n".join(lines)

    @property
    def attributes(self) -> str:
        """What a function is compiled for."""
        return f'"target-cpu"="{self.cpu}" "target-features"="{self.features}"'

    def limited(self, vectors: str) -> Target:
        """Return the processor without those of its vectors that are wider than asked for.

        Args:
            vectors: ``"avx512"``, ``"avx2"``, ``"baseline"`` (what every processor of its kind has), or nothing: all
                there is.

        Raises:
            ProblemError: another word, or vectors that the processor lacks.
        """
        there = {"avx512": self.permutes == 8, "avx2": self.permutes >= 4}
        known = [name for name, has in there.items() if has] + ["baseline"]
        if not vectors or vectors == known[0]:
            return self
        if vectors not in known:
            lacks = f", which this processor ({self.cpu}) lacks" if vectors in there else ""
            raise ProblemError(
                f"{VECTORS} is {vectors!r}{lacks}; expected one of {', '.join(known)}, or none: the widest are used"
            )
        if vectors == "baseline":
            return replace(self, cpu="", features="")
        wider = ("avx512", "avx10", "evex")
        kept = [flag for flag in self.features.split(",") if not flag[1:].startswith(wider)]
        return replace(self, cpu="haswell", features=",".join([*kept, "-avx512f"]))

    def _has(self, feature: str) -> bool:
        """Tell whether a feature is listed, and nothing is taken away that it is built upon."""
        flags, below = self.features.split(","), ("sse2", "avx", "avx2", "avx512f")
        return f"+{feature}" in flags and not any(f"-{name}" in flags for name in below[: below.index(feature) + 1])
