"""Compares the bits of two commits: decisions, inputs, datagrams, exported C and JSON of every policy kind.

    python benchmarks/same_bits.py COMMIT [--only TEXT]

The commit is checked out into a temporary folder. Both trees compute the same digests, each with its own code:

* for each policy of ``tests/catalogue.py`` on two random plants: the exported C code, with the measurements, decisions
  and inputs of 100 steps in its self-check, the fingerprint, and the datagrams that the nodes send in 60 steps;
* for each problem of ``tests/used.py``: the JSON documents of its description and of a short evaluation;
* for each built-in problem: the JSON documents of ``show`` and ``show --wire``.

The exit code is 1 if any digest differs. A text that a commit changes on purpose, such as the comment in a C file,
also changes a digest; ``--print NAME`` prints what a digest covers.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

HERE = Path(__file__).resolve().parents[1]
ROWS, STEPS, EVALUATED = 100, 60, 20_000
TIMES = ("seconds", "cpu_seconds", "lateness_ms", "elapsed", "work")


def timeless(document: Any) -> Any:
    """Return a document without measured times."""
    if isinstance(document, dict):
        return {key: timeless(value) for key, value in document.items() if key not in TIMES}
    return [timeless(value) for value in document] if isinstance(document, list) else document


def as_text(document: Any) -> str:
    """Return a document as text."""
    return json.dumps(timeless(document), sort_keys=True, default=repr)


def datagrams(loop: Any) -> str:
    """Return the datagrams that the nodes of a loop send over ideal links, as hexadecimal digits."""
    from taciturn.model.packets import roles
    from taciturn.nodes.node import Node
    from taciturn.nodes.packet import Wire
    from taciturn.nodes.simulated_plant import SimulatedPlant

    nodes = {role: Node(loop.policy, role, network=loop.network, seed=5) for role in roles(loop.policy)}
    plant, wire, lines = SimulatedPlant(loop, seed=3), Wire(loop.policy, loop.network, key=b"k" * 16), list[str]()
    waiting: dict[str, list[Any]] = {role: [] for role in nodes}
    u = None
    for tick in range(min(STEPS, loop.horizon or STEPS)):
        for role, node in nodes.items():
            packets, given = node.step(tick, plant.measurement if node.measures else None, waiting[role])
            waiting[role] = []
            lines += [wire.encode(packet).hex() for packet in packets]
            for other, peer in nodes.items():
                waiting[other] += [one for one in packets if other != role and (one.kind, one.link) in peer.readings]
            u = u if given is None else given
        plant.move(u)
    return "\n".join(lines)


def of_policies() -> Iterator[tuple[str, Callable[[], str]]]:
    """Yield what each policy of the catalogue exports and sends."""
    from catalogue import POLICIES, closed
    from systems import make_system

    from taciturn_export.folder import print_folder

    for seed, unstable in ((11, False), (7, True)):
        for name, build in POLICIES.items():

            def exported(build: Any = build, seed: int = seed, unstable: bool = unstable) -> str:
                found = print_folder(closed(build(make_system(seed, 3, 2, 2, unstable))), "device", rows=ROWS, seed=4)
                return as_text({path: text for path, text in found.files.items() if path.endswith((".c", ".h"))})

            def sent(build: Any = build, seed: int = seed, unstable: bool = unstable) -> str:
                return datagrams(closed(build(make_system(seed, 3, 2, 2, unstable))))

            yield f"{name}, plant {seed}: C", exported
            yield f"{name}, plant {seed}: datagrams", sent


def of_kinds() -> Iterator[tuple[str, Callable[[], str]]]:
    """Yield the documents of a problem of each kind."""
    from used import KINDS

    import taciturn
    from taciturn.study.describe import describe

    for name, problem in KINDS.items():

        def evaluated(problem: Any = problem) -> str:
            return as_text(taciturn.evaluate(problem, steps=EVALUATED, seed=2).document())

        def described(problem: Any = problem) -> str:
            return as_text(describe(problem).document()) + str(describe(problem))

        yield f"{name}: evaluate", evaluated
        yield f"{name}: show", described


def of_problems() -> Iterator[tuple[str, Callable[[], str]]]:
    """Yield what the command line prints for each built-in problem."""
    for path in sorted((HERE / "src").glob("*/problems/*.toml"), key=lambda found: found.stem):
        for words in (["show", path.stem, "--json"], ["show", path.stem, "--wire"]):

            def printed(words: list[str] = words) -> str:
                command = [sys.executable, "-m", "taciturn", *words]
                done = subprocess.run(command, capture_output=True, text=True, check=False)
                return done.stdout + done.stderr

            yield f"taciturn {' '.join(words)}", printed


def digests(only: str, whole: str | None) -> None:
    """Print a line of JSON for each case: its name and its digest, or the text itself."""
    import taciturn

    for name, compute in (case for cases in (of_policies, of_kinds, of_problems) for case in cases()):
        if only not in name or (whole is not None and name != whole):
            continue
        try:
            text = compute()
        except taciturn.TaciturnError as error:
            text = f"refused: {error}"
        if whole is not None:
            print(text)
        else:
            print(json.dumps([name, hashlib.blake2s(text.encode()).hexdigest(), text[:60]]), flush=True)


def of_tree(tree: Path, only: str) -> dict[str, list[str]]:
    """Return the digests of a tree."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tree / "src"), str(tree / "tests")])}
    command = [sys.executable, str(Path(__file__).resolve()), "--digests", "--only", only]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True, cwd=tree)
    return {name: rest for name, *rest in map(json.loads, done.stdout.splitlines())}


def main() -> None:
    """Compare two trees."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("commit", nargs="?", help="the other commit")
    parser.add_argument("--only", default="", help="compare only the names with this text")
    parser.add_argument("--digests", action="store_true", help="print the digests of the tree on the path")
    parser.add_argument("--print", dest="whole", help="print what the digest of this name covers")
    given = parser.parse_args()
    if given.digests or given.whole:
        digests(given.only, given.whole)
        return
    if given.commit is None:
        parser.error("COMMIT is missing; expected a commit of this repository")
    with TemporaryDirectory() as folder:
        archive = subprocess.run(["git", "archive", given.commit], cwd=HERE, capture_output=True, check=True).stdout
        subprocess.run(["tar", "-x", "-C", folder], input=archive, check=True)
        before, after = of_tree(Path(folder), given.only), of_tree(HERE, given.only)
    changed = [name for name in before if name in after and before[name] != after[name]]
    for name in changed:
        print(f"differs: {name}")
    for name in sorted(before.keys() ^ after.keys()):
        print(f"only {'before' if name in before else 'after'}: {name}")
    print(f"{len(before)} digests of {given.commit}, {len(after)} of this tree, {len(changed)} differ")
    sys.exit(bool(changed) or before.keys() != after.keys())


if __name__ == "__main__":
    main()
