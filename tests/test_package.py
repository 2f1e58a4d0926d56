"""What is given away: an archive of the sources, and the package that is built from it alone."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import taciturn

ROOT = Path(__file__).parent.parent
REASON = "NOT SHOWN: what is given away; no hatchling"


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder into which the package is put that is built from the archive of the sources."""
    sources = pytest.importorskip("hatchling.builders.sdist", reason=REASON)
    wheels = pytest.importorskip("hatchling.builders.wheel", reason=REASON)
    folder = tmp_path_factory.mktemp("package")
    (archive,) = sources.SdistBuilder(str(ROOT)).build(directory=str(folder), versions=["standard"])
    with tarfile.open(archive) as packed:
        packed.extractall(folder, **({"filter": "data"} if hasattr(tarfile, "data_filter") else {}))
    unpacked = folder / f"taciturn-{taciturn.__version__}"
    assert {"README.md", "CHANGELOG.md", "THIRD_PARTY.md", "tests", ".ci"} <= {path.name for path in unpacked.iterdir()}
    (wheel,) = wheels.WheelBuilder(str(unpacked)).build(directory=str(folder), versions=["standard"])
    with zipfile.ZipFile(wheel) as built:
        built.extractall(folder / "there")
    return folder / "there"


def test_the_package_holds_every_file_of_the_sources(package: Path) -> None:
    """Built-in problems, the C of devices, pages, bodies of robots, licences, and the mark that it is typed."""
    there = ROOT / "src" / "taciturn"
    expected = {path.relative_to(there) for path in there.rglob("*") if path.is_file() and path.suffix != ".pyc"}
    assert Path("py.typed") in expected
    assert expected == {
        path.relative_to(package / "taciturn") for path in (package / "taciturn").rglob("*") if path.is_file()
    }
    (metadata,) = package.glob("*.dist-info")
    assert metadata.name == f"taciturn-{taciturn.__version__}.dist-info"
    assert {path.name for path in metadata.glob("licenses/**/*")} >= {"LICENSE", "THIRD_PARTY.md", "uPlot.LICENSE"}


def test_the_citation_has_the_version_and_the_authors_of_the_package() -> None:
    """CITATION.cff, which reference managers read, and pyproject.toml."""
    cited = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    own = cited.partition("references:")[0]
    assert f"\nversion: {taciturn.__version__}\n" in own
    assert f"\nlicense: {project['license']}\n" in own
    assert re.findall(r"- name: (.*)", own) == [author["name"] for author in project["authors"]]


@pytest.mark.evidence
def test_the_package_runs_without_the_repository(package: Path, tmp_path: Path) -> None:
    """A number, a function from a file next to its problem, and C with the core that comes along."""
    environment = {**os.environ, "PYTHONPATH": str(package)}
    for arguments in (
        ("evaluate", "remote-scalar", "--json"),
        ("evaluate", "omni-heading", "--steps", "20000"),
        ("export", "two-mass-lqg", "--c", "device"),
    ):
        done = subprocess.run(
            [sys.executable, "-P", "-m", "taciturn", *arguments],
            cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "device" / "taciturn_node.c").exists()
