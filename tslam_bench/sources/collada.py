"""What a COLLADA document says about itself that trimesh's reader passes over: unit, up axis, instances, negative indices."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from tslam_bench.errors import AssetError

_UP_AXES = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}

_UNREAD = {
    "instance_controller": "parts that are moved by bones or morphed (controllers)",
    "ph": "polygons with holes",
    "brep": "curved surfaces (brep)",
}
"""Elements that are part of the shape and that trimesh leaves out."""


@dataclass(frozen=True)
class Document:
    """Facts of a COLLADA document.

    Attributes:
        unit: metres per unit.
        up: axis that points up: x, y or z.
        instances: geometries that its scenes show. A few hundred bytes of nodes that each instance the next one twice show
            more than any reader ends with.
    """

    unit: float
    up: str
    instances: int


def inspect(data: bytes) -> Document:
    """Reads a document's conventions and counts what it shows. Entities are left alone: no file is opened for one.

    Raises:
        AssetError: not COLLADA, nodes that instance each other in a circle, a negative index (numpy would count it from the
            end), parts that are never read, or a unit or axis that makes no sense.
    """
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise AssetError(f"not a readable .dae file ({error})") from error
    if root.tag.rpartition("}")[2] != "COLLADA":
        raise AssetError(f"not a COLLADA document: its root element is <{root.tag.rpartition('}')[2][:40]}>")
    if any("-" in (indices.text or "") for indices in root.iterfind(".//{*}p")):
        raise AssetError(".dae faces refer to vertices by negative numbers")
    for tag, what in _UNREAD.items():
        if root.find(f".//{{*}}{tag}") is not None:
            raise AssetError(f".dae with {what}, which cannot be read; export it without")
    stated = root.find("./{*}asset/{*}unit")
    meter = "1" if stated is None else stated.get("meter", "1")
    up = (root.findtext("./{*}asset/{*}up_axis") or "Y_UP").strip()
    try:
        unit = float(meter)
    except ValueError:
        unit = 0.0
    if up not in _UP_AXES or not (np.isfinite(unit) and unit > 0):
        raise AssetError(
            f".dae states up axis {up[:20]!r} and a unit of {meter[:20]!r} m; "
            f"expected one of {', '.join(_UP_AXES)} and a positive number"
        )
    return Document(unit, _UP_AXES[up], _instances(root))


def _instances(root: Element) -> int:
    """Geometries that the scenes show, all instances of nodes followed."""
    nodes = {node.get("id"): node for node in root.iterfind(".//{*}node")}

    @functools.cache
    def shown(element: Element) -> int:
        below = [nodes.get(link.get("url", "").lstrip("#")) for link in element.iterfind(".//{*}instance_node")]
        own = sum(1 for kind in ("geometry", "controller") for _ in element.iterfind(f".//{{*}}instance_{kind}"))
        return own + sum(shown(node) for node in below if node is not None)

    try:
        return sum(shown(scene) for scene in root.iterfind(".//{*}visual_scene"))
    except RecursionError as error:
        raise AssetError(".dae nodes instance each other in a circle, or in a very long chain") from error
