"""Target processor of a program in LLVM IR, with its vector features.

Any program can be translated with any number of lanes for any processor. Only the instruction for lookups in small
tables depends on the processor. LLVM terminates the process if a function uses an instruction that the features do not
include. Therefore the text contains the features, and is compiled for exactly these.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from taciturn.errors import ProblemError

VECTORS = "TACITURN_VECTORS"


@dataclass(frozen=True)
class Target:
    """Description of a processor for the compiler LLVM.

    Args:
        triple: architecture, vendor, and system.
        cpu: name of the processor; empty: any processor of the architecture.
        features: further features in LLVM's notation, such as ``"+avx2,-avx512f"``. The compiler also uses features
            that the name implies; the translation uses only those in this list.
    """

    triple: str
    cpu: str
    features: str

    @property
    def permutes(self) -> int:
        """Number of doubles that one instruction permutes by computed positions: 8 (AVX-512), 4 (AVX2) or 0."""
        if self.triple.partition("-")[0] not in ("x86_64", "amd64", "i686", "i386"):
            return 0
        return 8 if self._has("avx512f") else 4 if self._has("avx2") else 0

    @property
    def lanes(self) -> int:
        """Number of doubles in the widest vector of the processor; 2 (SSE2, NEON) if it is unknown."""
        return self.permutes or 2

    @property
    def heading(self) -> str:
        """First lines of an LLVM module for this processor."""
        lines = [f'target triple = "{self.triple}"']
        if "windows" in self.triple:
            lines.append("@_fltused = global i32 0")  # a symbol that the linker requires for floating-point code
        return "\n".join(lines)

    @property
    def attributes(self) -> str:
        """Attributes that specify this processor in an LLVM function."""
        return f'"target-cpu"="{self.cpu}" "target-features"="{self.features}"'

    def limited(self, vectors: str) -> Target:
        """Return a description of this processor, limited to a given set of vector instructions.

        Args:
            vectors: ``"avx512"``, ``"avx2"``, ``"baseline"`` (present in every processor of the
                architecture), or an empty text for the widest vectors.

        Raises:
            ProblemError: the kind is unknown, or the processor does not support it.
        """
        there = {"avx512": self.permutes == 8, "avx2": self.permutes >= 4}
        known = [name for name, has in there.items() if has] + ["baseline"]
        if not vectors or vectors == known[0]:
            return self
        if vectors not in known:
            lacks = f", which this processor ({self.cpu}) does not support" if vectors in there else ""
            raise ProblemError(
                f"{VECTORS} is {vectors!r}{lacks}; expected one of {', '.join(known)}, or no value for the widest"
            )
        if vectors == "baseline":
            return replace(self, cpu="", features="")
        wider = ("avx512", "avx10", "evex")
        kept = [flag for flag in self.features.split(",") if not flag[1:].startswith(wider)]
        return replace(self, cpu="haswell", features=",".join([*kept, "-avx512f"]))

    def _has(self, feature: str) -> bool:
        """Return whether a feature is in the list, and no feature that it requires is excluded."""
        flags, below = self.features.split(","), ("sse2", "avx", "avx2", "avx512f")
        return f"+{feature}" in flags and not any(f"-{name}" in flags for name in below[: below.index(feature) + 1])
