"""An exported folder is a library for PlatformIO and Arduino and a module for Zephyr, as their own tools read it."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest
from counts import few
from export.devices import STRICT, needs_compiler
from export.test_folders import two_mass, write

import taciturn
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn_export.folder import print_folder
from taciturn_export.library import LONGEST

REQUIRED = {"name", "version", "author", "maintainer", "sentence", "paragraph", "category", "url", "architectures"}
ARDUINO = """#include <stddef.h>
#include <stdint.h>
unsigned long micros(void);
"""
# both sketches in one program, with the network and the sensors that a user writes
MAIN = """#include "Arduino.h"
#include <stdio.h>
#include <string.h>
#include <two_mass_controller.h>
#include <two_mass_actuator.h>
static unsigned long now = 4294000000UL; /* wraps after 0.97 s */
unsigned long micros(void) { return (uint32_t)(now += 100); }
static uint8_t letter[TAC_DATAGRAM];
static size_t waiting;
static void put(const uint8_t *bytes, size_t size) { memcpy(letter, bytes, waiting = size); }
static size_t take(uint8_t *bytes)
{
  const size_t size = waiting;
  memcpy(bytes, letter, size);
  waiting = 0;
  return size;
}
namespace controller {
#include "controller.ino"
}
namespace actuator {
#include "actuator.ino"
}
int main()
{
  controller::setup();
  actuator::setup();
  if (controller::node == NULL || actuator::node == NULL) return 1;
  for (int i = 0; i < 20000; i++) {
    controller::loop();
    actuator::loop();
  }
  printf("%d %d %d\\n", (int)controller::node->tick, (int)actuator::node->tick,
         (int)(controller::node->counters.missed + actuator::node->counters.missed));
  return 0;
}
"""
ZEPHYR = """cmake_minimum_required(VERSION 3.13)
project(application C)
set(CONFIG_TACITURN_TWO_MASS y)
function(zephyr_library)
  add_library(nodes STATIC)
endfunction()
function(zephyr_library_sources)
  target_sources(nodes PRIVATE ${ARGN})
endfunction()
function(zephyr_include_directories)
  target_include_directories(nodes PUBLIC ${ARGN})
endfunction()
function(zephyr_library_compile_options)
  target_compile_options(nodes PRIVATE ${ARGN})
endfunction()
add_subdirectory(nodes/zephyr module)
add_executable(application main.c)
target_link_libraries(application nodes)
"""
PROGRAM = """#include "two_mass_actuator.h"
static two_mass_actuator memory;
int main(void) {
  const tac_key none = {NULL, 0};
  return two_mass_actuator_start(&memory, 1, 0, none) == NULL;
}
"""


def tool(name: str) -> str:
    """Return a program, or skip the test."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"NOT SHOWN: what {name} makes of an exported folder; there is none")
    return found


def remote() -> Loop:
    """Return a loop whose three nodes are at three places."""
    problem = taciturn.load("remote-double-integrator")
    return problem.close(problem.design())


def test_sketches_and_the_library_run_as_on_an_arduino(tmp_path: Path) -> None:
    """Everything in ``src``, nothing else, as C; the sketches as C++: the actuator keeps to the controller's steps."""
    found = print_folder(two_mass(), "two_mass", rows=1)
    source = write(tmp_path, found) / "src"
    objects = [path.with_suffix(".o") for path in source.glob("*.c")]
    options = [needs_compiler(), "-std=c99", "-O0", "-c", f"-I{source}"]
    subprocess.run([*options, *(path.with_suffix(".c").name for path in objects)], cwd=source, check=True)
    for role, text in (("controller", "y[i] = (micros() >> 20) & 1"), ("actuator", "")):
        sketch = (tmp_path / "examples" / f"two_mass_{role}" / f"two_mass_{role}.ino").read_text()
        sketch = sketch.replace("  (void)bytes;\n  return 0;\n", "  return take(bytes);\n")
        sketch = sketch.replace("  (void)bytes;\n  (void)size;\n", "  put(bytes, size);\n")
        (tmp_path / f"{role}.ino").write_text(sketch.replace("y[i] = 0", text or "y[i] = 0"))
        assert "take(" in sketch
        assert "put(" in sketch
    (tmp_path / "Arduino.h").write_text(ARDUINO)
    (tmp_path / "main.cpp").write_text(MAIN)
    command = [tool("c++"), "-Wall", "-Wextra", "-Werror", f"-I{source}", "main.cpp", *map(str, objects), "-o", "main"]
    subprocess.run(command, cwd=tmp_path, check=True)
    done = subprocess.run([str(tmp_path / "main")], capture_output=True, text=True, check=True)
    one, other, missed = map(int, done.stdout.split())
    assert one > 400
    assert one - other in (0, 1)
    assert missed == 0


@pytest.mark.parametrize("role", few(["sensor", "controller", "actuator"], 1))
def test_every_sketch_compiles(role: str, tmp_path: Path) -> None:
    """Of a sensor alone, of a controller between two links and of an actuator alone."""
    folder = write(tmp_path, print_folder(remote(), "policy", rows=1))
    flags = [flag for flag in STRICT if flag not in ("-std=c99", "-Wstrict-prototypes")]
    (folder / "Arduino.h").write_text(ARDUINO)
    sketch = folder / "examples" / f"policy_{role}" / f"policy_{role}.ino"
    options = ["-include", "Arduino.h", "-I.", f"-I{folder / 'src'}", "-x", "c++", "-c", str(sketch), "-o", "sketch.o"]
    subprocess.run([tool("c++"), *flags, *options], cwd=folder, check=True)


def test_the_self_check_is_not_part_of_the_library() -> None:
    """It has a main of its own; all that a device needs is there, and of one node that node alone."""
    files = print_folder(two_mass(), "two_mass", nodes=["actuator"], rows=1).files
    held = {name.removeprefix("src/") for name in files if name.startswith("src/")}
    assert {"taciturn.h", "taciturn_node.c", "two_mass_actuator.c", "two_mass_actuator.h"} <= held <= files.keys()
    assert not any("selfcheck" in name or "exchange" in name or "controller" in name for name in held)
    assert [name for name in files if name.endswith(".ino")] == ["examples/two_mass_actuator/two_mass_actuator.ino"]
    assert "controller" not in files["zephyr/CMakeLists.txt"]


def test_the_descriptions_hold_what_their_specifications_require() -> None:
    """Fields, names of at most 63 characters, and paths that exist."""
    found = print_folder(two_mass(), "p" * 80, rows=1).files
    lines = [line.split("=", 1) for line in found["library.properties"].splitlines() if not line.startswith("#")]
    properties = dict(lines)
    assert properties.keys() >= REQUIRED
    assert all(properties.values())
    assert properties["name"] == json.loads(found["library.json"])["name"] == f"taciturn_{'p' * 80}"[:LONGEST]
    assert properties["version"] == json.loads(found["library.json"])["version"] == taciturn.__version__
    for header in [*properties["includes"].split(","), *json.loads(found["library.json"])["headers"]]:
        assert f"src/{header}" in found
    assert "  cmake: zephyr\n  kconfig: zephyr/Kconfig\n" in found["zephyr/module.yml"]
    assert {"zephyr/CMakeLists.txt", "zephyr/Kconfig"} <= found.keys()


def test_an_earlier_library_goes_and_files_of_others_stay(tmp_path: Path) -> None:
    """Also in folders below, of which an empty one goes too."""
    mine = [tmp_path / "src" / "mine.c", tmp_path / "examples" / "mine" / "mine.ino"]
    for path in mine:
        path.parent.mkdir(parents=True)
        path.write_text("/* mine */\n")
    write(tmp_path, print_folder(two_mass(), "old", rows=1))
    write(tmp_path, print_folder(two_mass(), "new", rows=1))
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith("old")]
    assert all(path.read_text() == "/* mine */\n" for path in mine)
    assert (tmp_path / "src" / "new_actuator.c").is_file()


@pytest.mark.parametrize("name", ["library.json", "library.properties", "zephyr/module.yml", "src", "examples"])
def test_a_library_of_others_is_not_replaced(name: str, tmp_path: Path) -> None:
    """Nor a file where a folder is to be; then nothing is written."""
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text('{ "name": "mine" }\n')
    with pytest.raises(ProblemError, match=rf"{name} already exists and is not from an earlier export"):
        write(tmp_path, print_folder(two_mass(), "two_mass", rows=1))
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [tmp_path / name]


@pytest.mark.evidence
def test_zephyr_s_build_file_builds(tmp_path: Path) -> None:
    """Zephyr's four functions are replaced by what they do; Zephyr itself is not here."""
    write(tmp_path / "nodes", print_folder(two_mass(), "two_mass", rows=1))
    (tmp_path / "CMakeLists.txt").write_text(ZEPHYR)
    (tmp_path / "main.c").write_text(PROGRAM)
    cmake = tool("cmake")
    subprocess.run([cmake, "-B", "build", "."], cwd=tmp_path, check=True, capture_output=True)
    subprocess.run([cmake, "--build", "build"], cwd=tmp_path, check=True, capture_output=True)
    assert subprocess.run([str(tmp_path / "build" / "application")], check=False).returncode == 0


@pytest.mark.evidence
def test_platformio_packs_the_library(tmp_path: Path) -> None:
    """Its packager reads and checks ``library.json``, and refuses a wrong one."""
    pio, folder = tool("pio"), write(tmp_path / "nodes", print_folder(two_mass(), "two_mass", rows=1))
    command = [pio, "pkg", "pack", str(folder), "-o", str(tmp_path / "nodes.tar.gz")]
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "PLATFORMIO_CORE_DIR": str(tmp_path / "core")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Wrote a tarball" in done.stdout
    (folder / "library.json").write_text(json.dumps({"name": "a/b", "version": "1"}))
    assert subprocess.run(command, env=environment, capture_output=True, check=False).returncode != 0


@pytest.mark.evidence
def test_west_and_kconfig_read_the_module(tmp_path: Path) -> None:
    """A manifest names the folder as a project; the YAML and the option are read by the libraries that Zephyr uses."""
    west = tool("west")
    nodes = write(tmp_path / "nodes", print_folder(two_mass(), "two_mass", rows=1))
    manifest = tmp_path / "work" / "app" / "west.yml"
    manifest.parent.mkdir(parents=True)
    manifest.write_text(
        f"manifest:\n  projects:\n    - name: nodes\n      url: file://{nodes}\n      revision: main\n"
        "  self:\n    path: app\n"
    )
    who = ["-c", "user.name=nobody", "-c", "user.email=nobody@example.org"]
    for arguments in (["init", "-q", "-b", "main"], ["add", "-A"], [*who, "commit", "-qm", "nodes"]):
        subprocess.run(["git", *arguments], cwd=nodes, check=True)
    for arguments in (["init", "-l", "app"], ["manifest", "--validate"], ["update"]):
        subprocess.run([west, *arguments], cwd=tmp_path / "work", check=True, capture_output=True)
    listed = subprocess.run(
        [west, "list", "-f", "{name} {abspath}", "nodes"], cwd=tmp_path / "work", check=True, capture_output=True,
        text=True,
    ).stdout.split()  # fmt: skip
    script = (
        "import sys, yaml, kconfiglib\nfrom pathlib import Path\nroot = Path(sys.argv[1])\n"
        "build = yaml.safe_load((root / 'zephyr/module.yml').read_text())['build']\n"
        "assert (root / build['cmake'] / 'CMakeLists.txt').is_file()\n"
        "options = kconfiglib.Kconfig(str(root / build['kconfig']))\n"
        "print(*(one.name for one in options.unique_defined_syms), *options.warnings)\n"
    )
    done = subprocess.run(
        [str(Path(west).with_name("python")), "-c", script, listed[1]], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout.split()) == (0, ["TACITURN_TWO_MASS"]), done.stderr
