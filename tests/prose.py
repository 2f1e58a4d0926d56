"""The sentences of the project, and the terms and patterns that none of them may use.

``python tests/prose.py PATH ...`` prints what it finds; without a path it reads the README, the pages and the sources.
"""

import ast
import json
import re
import sys
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

from imports import nodes

ROOT = Path(__file__).parent.parent
TERMS = {  # pattern: what a control engineer's textbook says instead
    r"(?<![-._\w])(?<!wall )clocks?\b(?![:=.(_])": "periodic (time-triggered) control",
    r"(?<![-._\w])ticks?\b(?![:=(_]| is )": "step, or sampling instant",
    r"\b(?:a|each|every|one|two|per|between|next|last) looks?\b|\blooks (?:since|between|per)\b": "check",
    r"\b(?:sends?|sending) always\b|\balways sending\b": "sending every sample",
    r"\ball-time (?:cost|control|LQG)s?\b": "periodic LQG at every sample",
    r"\bnever[- ]die\b": "conditional (survival-weighted) sampling",
    r"\bprice of silence\b": "trigger threshold",
    r"\bknobs?\b": "tuning parameter",
    r"\bmissions?\b": "finite-horizon run",
    r"\bdepartures?\b": "difference from the design",
    r"\bedge of stability\b": "marginally stable",
    r"\b(?:is|are) the meaning\b|\(the meaning\)": "reference implementation",
    r"\bparity build\b": "bit-exact build",
    r"\b(?:has|have|with) the (?:same )?bits\b": "bit-identical to",
    r"\b(?:lose|loses|losing|lost) (?:a |the |its |some |all )?packets?\b": "drop packets",
    r"\bhous(?:e|es)\b|\bspine\b|\bfloors\b": "structure, layer",
    r"\b(?:stands?|stood) (?:here|there|in|beside|for|behind|alone|under|as|on|at)\b": "is, has, contains",
    r"\bbears?\b|\bborne\b|\bmend(?:s|ed|ing)?\b|\bknows? of\b|\bknown of\b": "supports, fixes, has",
    r"\b(?:goes?|went|going) on\b": "continues",
    r"\bbeside\b": "next to, compared with",
    r"\b(?:is|are|was|were|be|been|not) (?:told|said|asked|heard)\b": "show, print, report, raise, accept",
}
PATTERNS = {  # of a sentence: what it should do instead
    r"^(?:What|Who|Whoever|Whatever)\b": "name the actor",
    r"^Of (?:a|an|the|this|these|those|several|all|its|each|every|such|one|two|what)\b": "put the subject first",
}
NOT_OURS = {"THIRD_PARTY.md"}  # licences
ANY = re.compile("|".join(TERMS), re.IGNORECASE)
FRAMED = re.compile("|".join(PATTERNS))
EXCEPT = {  # (files, the pattern's suggestion): why
    ("src/taciturn_twins/*", "finite-horizon run"): "a robot has a mission",
    ("src/taciturn_export/*.py", "step, or sampling instant"): "C source with a variable of this name",
    ("src/taciturn_export/*.py", "periodic (time-triggered) control"): "C source with a member of this name",
    ("src/taciturn_udp/*.py", "periodic (time-triggered) control"): "clocks of machines, which drift and jump",
    ("src/taciturn_worlds/*.py", "periodic (time-triggered) control"): "clocks of machines, which drift and jump",
    ("src/taciturn_explore/recorded_*.py", "periodic (time-triggered) control"): "clocks of machines, as in worlds",
    ("src/taciturn_export/*.py", "finite-horizon run"): "a template with a placeholder of this name",
    ("src/taciturn/program/llvm.py", "step, or sampling instant"): "source in LLVM's language with labels of this name",
}


def blocks(path: Path) -> Iterator[tuple[int, str]]:
    """Every paragraph, docstring and message of a file, with the line where it begins."""
    if path.suffix == ".py":
        for node in nodes(path):
            if isinstance(node, ast.JoinedStr):
                said = "".join(part.value if isinstance(part, ast.Constant) else "0" for part in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                said = node.value
            else:
                continue
            if len(said.split()) > 2:
                said = re.sub(r"(?m)^\s*(?:>>>|\.\.\.) .*$", "", said)
                for paragraph in re.split(r"\n\s*\n", said):
                    yield node.lineno, paragraph
        return
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        text = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    text = re.sub(r"^(```|~~~).*?^\1", lambda found: "\n" * found[0].count("\n"), text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"\A---\n.*?\n---\n", lambda found: "\n" * found[0].count("\n"), text, flags=re.DOTALL)
    line = 1
    for paragraph in re.split(r"(\n\s*\n|\n(?=[-*|#>] ?))", text):
        yield line, paragraph
        line += paragraph.count("\n")


def sentences(path: Path) -> Iterator[tuple[int, str]]:
    """Its sentences without code, links' targets and formulas."""
    for line, block in blocks(path):
        block = re.sub(r"^\s+\w+: ", "", block, flags=re.MULTILINE) if path.suffix == ".py" else block
        block = re.sub(r"\*[a-z0-9\s]+\* \(`[\w/]+\.py`\)", "·", block)  # the name of a test, and its file
        plain = re.sub(r"`+[^`]*`+|\$[^$]*\$|\]\([^)]*\)|<[^>]*>|https?://\S+", "·", block)
        plain = re.sub(r"\s+", " ", plain.replace("*", "")).strip(" #|").removeprefix("- ")
        for sentence in re.split(r"(?<=[.!?:])\s+(?=[A-Z0-9\"'\[·])|\s\|\s", plain):
            if sentence:
                yield line, sentence.strip()


def faults(path: Path) -> Iterator[str]:
    """Every sentence of a file that uses a term or a pattern of the lists."""
    name = path.resolve().relative_to(ROOT).as_posix()
    for line, sentence in sentences(path):
        if not (ANY.search(sentence) or FRAMED.search(sentence)):
            continue
        for pattern, instead in {**TERMS, **PATTERNS}.items():
            if sentence.endswith("?") and pattern in PATTERNS:
                continue
            if any(fnmatch(name, files) and instead == what for files, what in EXCEPT):
                continue
            for found in re.finditer(pattern, sentence, 0 if pattern in PATTERNS else re.IGNORECASE):
                yield f"{name}:{line}: '{found[0]}' ({instead}): {sentence[:140]}"


def texts() -> list[Path]:
    """What is read."""
    written = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("docs/**/*.ipynb")]
    sources = [*ROOT.glob("examples/*.py"), *ROOT.glob("src/**/*.py")]
    return sorted(path for path in [*written, *sources] if path.name not in NOT_OURS)


if __name__ == "__main__":
    for each in [Path(name) for name in sys.argv[1:]] or texts():
        for fault in faults(each):
            print(fault)
