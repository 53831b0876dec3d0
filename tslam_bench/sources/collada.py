"""What a COLLADA document says about itself, read before a library builds anything of it.

One pass finds the unit and the up axis (trimesh ignores both) and follows the scene's instances, because a few hundred bytes of
nodes that instance each other twice make more triangles than fit any memory.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from xml.parsers import expat

import numpy as np

from tslam_bench.errors import AssetError

MAX_DEPTH = 200
"""Deepest nesting of elements, and longest chain of nodes that instance each other."""
_PRIMITIVES = ("triangles", "polylist", "polygons", "tristrips", "trifans")
_UP_AXES = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}


@dataclass(frozen=True)
class Document:
    """Facts of a COLLADA document.

    Attributes:
        unit: metres per unit.
        up: axis that points up: x, y or z.
        instances: geometries that its largest scene shows.
        corners: corners of polygons that these have together; their triangles are fewer.
    """

    unit: float
    up: str
    instances: int
    corners: int


def inspect(data: bytes) -> Document:
    """Reads a COLLADA document's conventions and counts what its scene holds.

    Raises:
        AssetError: not XML, a document type is declared (its entities can be bombs or reach other files), elements or nodes
            are nested too deeply or in a circle, an index is negative, or unit and axis make no sense.
    """
    reader = _Reader()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = reader.start
    parser.EndElementHandler = reader.end
    parser.CharacterDataHandler = reader.text
    parser.StartDoctypeDeclHandler = reader.refuse_document_type
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise AssetError(f"not a readable .dae file ({error})") from error
    if reader.root != "COLLADA":
        raise AssetError(f"not a COLLADA document: its root element is <{reader.root[:40]}>")
    up = _UP_AXES.get(reader.up_axis.strip())
    try:
        unit = float(reader.meter)
    except ValueError:
        unit = 0.0
    if up is None or not (np.isfinite(unit) and unit > 0):
        raise AssetError(
            f".dae states up axis {reader.up_axis.strip()[:20]!r} and a unit of {reader.meter[:20]!r} m; "
            f"expected one of {', '.join(_UP_AXES)} and a positive number"
        )
    instances, corners = reader.largest_scene()
    return Document(unit, up, instances, corners)


@dataclass
class _Node:
    """A node or a visual scene: what it shows itself, and what it refers to."""

    geometries: list[str] = field(default_factory=list)
    children: list[int] = field(default_factory=list)
    references: list[str] = field(default_factory=list)


class _Reader:
    """Handlers of the XML parser."""

    def __init__(self) -> None:
        self.root = ""
        self.meter = "1"
        self.up_axis = "Y_UP"
        self._path: list[str] = []
        self._nodes: list[_Node] = []
        self._open_nodes: list[int] = []
        self._scenes: list[int] = []
        self._by_id: dict[str, list[int]] = defaultdict(list)
        self._geometry = ""
        self._corners: dict[str, int] = defaultdict(int)
        self._stride = 1
        self._indices = 0
        self._inside_index = False
        self._collect: str | None = None

    def refuse_document_type(self, *_: object) -> None:
        raise AssetError("declares a document type or entities, which COLLADA does not need: refused as a bomb")

    def start(self, name: str, attributes: dict[str, str]) -> None:
        tag = name.rpartition(":")[2]
        self.root = self.root or tag
        self._path.append(tag)
        if len(self._path) > MAX_DEPTH:
            raise AssetError(f".dae elements are nested deeper than {MAX_DEPTH}")
        if self._path[:2] == ["COLLADA", "asset"]:
            if tag == "unit":
                self.meter = attributes.get("meter", "1")
            elif tag == "up_axis":
                self._collect = ""
        elif tag in ("node", "visual_scene"):
            self._open_node(tag, attributes.get("id", ""))
        elif tag == "instance_node" and self._open_nodes:
            self._nodes[self._open_nodes[-1]].references.append(attributes.get("url", "").lstrip("#"))
        elif tag in ("instance_geometry", "instance_controller") and self._open_nodes:
            self._nodes[self._open_nodes[-1]].geometries.append(attributes.get("url", "").lstrip("#"))
        elif tag == "geometry":
            self._geometry = attributes.get("id", "")
        elif tag in _PRIMITIVES:
            self._stride = 1
        elif tag == "input":
            offset = attributes.get("offset", "0")
            self._stride = max(self._stride, int(offset) + 1 if offset.isdecimal() and len(offset) < 4 else 1)
        elif tag == "p":
            self._indices, self._inside_index = 0, False

    def end(self, name: str) -> None:
        tag = self._path.pop()
        if tag in ("node", "visual_scene"):
            self._open_nodes.pop()
        elif tag == "up_axis" and self._collect is not None:
            self.up_axis, self._collect = self._collect, None
        elif tag == "p" and self._path and self._path[-1] in _PRIMITIVES:
            self._corners[self._geometry] += self._indices // self._stride

    def text(self, content: str) -> None:
        if self._collect is not None:
            self._collect += content
        elif self._path and self._path[-1] == "p":
            if "-" in content:
                raise AssetError(".dae faces refer to vertices by negative numbers")
            continued = self._inside_index and not content[0].isspace()
            self._indices += len(content.split()) - continued
            self._inside_index = not content[-1].isspace()

    def _open_node(self, tag: str, identifier: str) -> None:
        index = len(self._nodes)
        self._nodes.append(_Node())
        if self._open_nodes:
            self._nodes[self._open_nodes[-1]].children.append(index)
        if tag == "visual_scene":
            self._scenes.append(index)
        elif identifier:
            self._by_id[identifier].append(index)
        self._open_nodes.append(index)

    def largest_scene(self) -> tuple[int, int]:
        """Geometries that the largest visual scene shows, and their corners, all instances followed."""
        below = {
            index: [*node.children, *(target for name in node.references for target in self._by_id.get(name, []))]
            for index, node in enumerate(self._nodes)
        }
        try:
            order = list(TopologicalSorter(below).static_order())
        except CycleError as error:
            raise AssetError(".dae nodes instance each other in a circle") from error
        instances: dict[int, int] = {}
        corners: dict[int, int] = {}
        height: dict[int, int] = {}
        for index in order:
            shown = self._nodes[index].geometries
            instances[index] = len(shown) + sum(instances[k] for k in below[index])
            corners[index] = sum(self._corners.get(name, 0) for name in shown) + sum(corners[k] for k in below[index])
            height[index] = 1 + max((height[k] for k in below[index]), default=0)
        if max(height.values(), default=0) > MAX_DEPTH:
            raise AssetError(f".dae nodes instance each other in a chain longer than {MAX_DEPTH}")
        return (
            max((instances[index] for index in self._scenes), default=0),
            max((corners[index] for index in self._scenes), default=0),
        )
