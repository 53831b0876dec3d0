"""Writes the table of docs/importing.md: what bad input gets, by importing it.

python docs/build_importing.py           # write
python docs/build_importing.py --check   # fail if the table is out of date
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from sections import filled, table, write_or_check

from tslam_bench.geometry.meshes import TriangleMesh
from tslam_bench.sources.generator import generate

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
import fuzz_importer
from mesh_mutations import GEOMETRY, HOSTILE, Mutant, write

TARGET = Path(__file__).parent / "importing.md"

_DAMAGED = (
    ("an empty file", "empty", "stl"),
    ("no faces", "no faces", "off"),
    ("one triangle, slanted: a sheet without thickness", "one triangle", "stl"),
    ("all vertices in one plane", "flat", "stl"),
    ("all vertices in one point", "one point", "ply"),
    ("a vertex that is not a number", "vertex not a number", "stl"),
    ("a vertex a billion times too far out", "vertex far out", "stl"),
    ("inside out", "inside out", "stl"),
    ("a fifth of the faces flipped", "some faces flipped", "stl"),
    ("a few faces missing", "few faces removed", "stl"),
    ("faces twice", "faces duplicated", "stl"),
    ("vertices pushed through the other side", "self-intersecting", "stl"),
    ("40 m long, unit stated", "metres: 40 m", "stl"),
    ("0.1 mm long, unit stated", "metres: 1000 times too small", "stl"),
)
_FILES = (
    ("a PNG named .obj", "picture.obj"),
    ("a web page named .stl", "page.stl"),
    ("a SketchUp file", "model.skp"),
    ("another format", "model.fbx"),
    ("a header for 4 billion triangles", "count.stl"),
    ("counts above the file's lines", "counts.off"),
    ("an index that is not there", "index.glb"),
    ("vertex 0 of an .obj", "zero-index.obj"),
    ("glTF: a trillion items without data", "count-without-data.glb"),
    ("glTF: a negative offset", "negative-offset.glb"),
    ("glTF: compressed", "draco.glb"),
    ("glTF: a buffer by its address", "address.gltf"),
    ("glTF: a buffer in another folder", "outside.gltf"),
    ("glTF: nodes in a circle", "circle.glb"),
    ("COLLADA: nodes in a circle", "circle.dae"),
    ("COLLADA: 30 nodes that each show the next one twice", "doubling.dae"),
    ("COLLADA: entities (billion laughs, files of the system)", "laughs.dae"),
    ("COLLADA: elements nested 100,000 deep", "deep.dae"),
    ("archive: a bomb", "bomb.zip"),
    ("archive: a path that leaves it", "escape.zip"),
    ("archive: encrypted", "encrypted.zip"),
    ("archive: two meshes", "two.zip"),
)


@dataclass(frozen=True)
class Config:
    """Writes or checks the table of docs/importing.md."""

    check: bool = False
    """Only compare; exit with status 1 if the table is out of date."""


def damaged(mesh: TriangleMesh, kind: str, suffix: str) -> Mutant:
    """A file with one kind of damage."""
    generator = np.random.Generator(np.random.PCG64(0))
    if kind == "empty":
        return Mutant(kind, f"shape.{suffix}", {f"shape.{suffix}": b""})
    name, files = write(GEOMETRY[kind](mesh, generator), suffix, "shape")
    return Mutant(kind, name, files, in_metres=kind.startswith("metres"))


def rows() -> list[tuple[str, str]]:
    """What was imported, and what it got."""
    carton = generate.draw("carton", 1)[0]
    items = [(text, damaged(carton, kind, suffix)) for text, kind, suffix in _DAMAGED]
    for text, name in _FILES:
        content = HOSTILE[name]
        items.append((text, Mutant("hostile", name, content if isinstance(content, dict) else {name: content})))
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for number, (text, item) in enumerate(items):
            (source,) = fuzz_importer.write_mutants([item], Path(folder) / str(number))
            status, reason = fuzz_importer.cheap_import(source, Path(folder))
            method = {
                "kept": "as it is",
                "winding": "after repair",
                "ball": "after repair by a rolling ball",
                "closed": "after its openings were closed",
            }
            found.append((text, f"accepted {method[reason]}" if status == "accepted" else f"`{reason}`"))
    return found


def main(config: Config) -> None:
    """Writes the table, or compares it."""
    text = table(("file", "what it gets"), rows())
    write_or_check({TARGET: filled(TARGET, {"bad-input": text})}, config.check)


if __name__ == "__main__":
    main(tyro.cli(Config))
