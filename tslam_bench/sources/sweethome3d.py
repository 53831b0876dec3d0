"""Household models of Sweet Home 3D: real meshes for the train and val splits.

They come in one Debian package (CC0 and CC-BY 3.0) that any operating system can read: an ``ar`` archive around a tar
archive around five zip archives, each with its models and a catalogue of names, sizes and creators.
"""

from __future__ import annotations

import hashlib
import io
import re
import tarfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from tslam_bench.errors import AssetError
from tslam_bench.files import atomic_directory, write_json
from tslam_bench.geometry.meshes import TriangleMesh
from tslam_bench.sources.fetch import fetch_file
from tslam_bench.sources.meshfiles import parse_mesh
from tslam_bench.sources.scaling import scale_to_hand
from tslam_bench.sources.source import SourceMesh
from tslam_bench.sources.wheels import FURNITURE_PACKAGE

LICENSES = {
    "BlendSwap-CC-0": "CC0-1.0",
    "BlendSwap-CC-BY": "CC-BY-3.0",
    "KatorLegaz": "CC-BY-3.0-US",
    "Scopia": "CC-BY-3.0",
}
"""Catalogue -> licence of its models. (A fifth catalogue holds people.)"""
_CATALOGUE = "PluginFurnitureCatalog.properties"

_LEFT_OUT = (
    r"plug|switch|socket|\barrow|parking|crossing|^rails|^bill |rug$|carpet|bathmat|tatami|doormat|newspaper|curtain|railing|"
    r"fence|hedge|window|\bdoor\b|shower|sidewalk|swimming pool|jacuzzi|diving|column|chimney|fireplace|furnace|sandpit|barnum|"
    r"hanging light|chandelier|acacia|bamboo|ficus|\bpine|cypress|beech|maple|poplar|coconut|palm tree|blossom|\bbush|shipping|"
    r"stair|escalator|elevator|hanging clothes|emergency|spotlight|track lights|fluorescent|wall light|wall lamp|ceiling|pendant|"
    r"porch light|ruler|puzzle|calendar|white board|\bhut|tent\b|hammock|living room$|plate, glass|goal|mannequin|"
    r"\bmale|\bfemale|\bnet$|kitchen tools|utensils|entry|smoke|trampoline|children game"
)
"""Names of what is no object to hold: fixtures of buildings, flat markings, trees, groups of things, people."""

_CATEGORIES = (
    ("armchair", r"armchair"),
    ("stool", r"stool|puff|ottoman"),
    ("wheelchair", r"wheelchair|stroller|wheelbarrow|mower"),
    ("chair", r"chair|class seat|lounge"),
    ("bench", r"bench|\bbank$"),
    ("sofa", r"sofa|couch|futon"),
    ("bed", r"bed$|crib|mattress|sleeping bag"),
    ("game", r"pool table|football table|table tennis$|flipper|chessboard|dart|card game|rubik"),
    (
        "dresser",
        r"bedside|dresser|drawers|dressing table|vanity|tv stand|television cabinet|changing table|chest$|trunck",
    ),
    ("racket", r"racket|bat$"),
    ("fan", r"\bfan$|conditioning"),
    ("tablet", r"tablet|\bbook$|ibook|laptop"),
    ("desk", r"desk$"),
    ("lamp", r"lamp|lantern|park light|street light|candle|flashlight"),
    ("table", r"table|trestles"),
    ("shelf", r"bookcase|shelves|shelf"),
    ("cabinet", r"wardrobe|cupboard|cabinet|locker|safe|island"),
    ("plant", r"plant|orchid|cactus|tulips|lily|yucca|spathi|flower|bonsai|christmas tree"),
    ("two-wheeler", r"bike|bicycle|tricycle|scooter|yamaha|skateboard"),
    ("car", r"\bcar\b|sedan|focus|leon|peugeot|renault|suv|chevrolet|beetle"),
    ("truck", r"truck|bus$|\bvan$|fork lift"),
    ("toy", r"train$|biplane|rowboat|rocking horse|teddy|doll|toy|snowman|swing|seesaw"),
    ("instrument", r"piano|guitar|keyboard|xylophone"),
    ("bottle", r"bottle|flacon|milk|oil servers"),
    ("food", r"cake|bread$|hot dog|hamburger|steak|chicken$|fries|butter|apples|fruits|salad|sushi"),
    ("cup", r"\bcup$|mug"),
    ("spectacles", r"^glasses|sunglasses"),
    ("glass", r"glass$"),
    ("washbasin", r"washbasin|sink|\bbath$|bathtub|lavatory"),
    ("bowl", r"bowl|pottery|basin$"),
    ("plate", r"plate|tray|ashtray|hashtray"),
    ("kettle", r"teapot|kettle|creamer|coffee press"),
    ("kitchen-appliance", r"coffee|mixer|blender|toaster|sandwich|squeezer|fryer|grill|scale"),
    ("oven", r"oven|stove|cooker|cooktop|hood|microwave|boiler|heater$"),
    ("refrigerator", r"fridge|refrigerator|freezer|washing|dryer|water cooler"),
    ("toilet", r"toilet|urinal|bidet|potty"),
    ("bin", r"\bbin$|trash|dustbin|barrel|crate|\bbasket$"),
    ("bag", r"backpack|handbag"),
    ("box", r"box|gift|pallet|briefcase|suitcase"),
    ("headphones", r"headphone"),
    ("phone", r"phone|intercom|remote|joystick|playstation"),
    ("camera", r"camera|reflex|cctv|projector"),
    ("audio", r"speaker|radio$|stereo|mp3|dvd|amplifier"),
    ("screen", r"\btv\b|screen|imac|printer"),
    ("radiator", r"radiator"),
    ("cutlery", r"knife|fork$|spoon|chopping"),
    ("pan", r"pan$"),
    ("scissors", r"scissors|pliers"),
    ("tool", r"tool$|hammer|screwdriver|drill|grinder|saw$|shovel|broom|tape|extinguisher|hose|faucet"),
    ("brush", r"brush|comb$|sponge|soap|lip stick|cosmetics"),
    ("stationery", r"pencil|marker|stapler|thermometer|letter"),
    ("shoe", r"shoes|sneakers|slippers|bootie|mocassin"),
    ("hat", r"\bhat$|\bcap$|helmet|glove|umbrella"),
    ("clothing", r"jacket|skirt|short|trousers|suit$|dress$|towel|clothes"),
    ("ball", r"ball$"),
    ("clock", r"watch|clock"),
    ("trinket", r"\bring$|keys|lock$|frame"),
    ("animal", r"horse|\bdog$|\bcat$|rabbit|chicken|deer|bulldog"),
    ("vase", r"vase|jar$|sugar|salt|spice"),
    ("stone", r"rock|fountain|hydrant|cone$|logs"),
    ("exercise", r"treadmill|ladder|tower$|abdominal|aquarium|hanger"),
)
"""(category, pattern of the lower-case name); the first that fits counts."""

VAL_CATEGORIES = frozenset(
    {"bench", "two-wheeler", "instrument", "shoe", "hat", "bag", "racket", "clock", "stone", "wheelchair"}
)
"""Categories that are held out for val."""


@dataclass(frozen=True)
class FurnitureSource:
    """One model of the package.

    Attributes:
        split, category: where it belongs.
        catalogue: name of its catalogue.
        number: its number there.
        title: its name there.
        member: path of its OBJ file in the catalogue's zip archive.
        creator: whom to name.
        rotation: (9,) rotation that the catalogue prescribes, row by row, or None.
    """

    split: str
    category: str
    catalogue: str
    number: int
    title: str
    member: str
    creator: str
    rotation: tuple[float, ...] | None

    @property
    def name(self) -> str:
        """Name of the object: title, catalogue and number."""
        title = re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-") or "model"
        return f"{title}-{self.catalogue.lower()}-{self.number:03d}"

    def fingerprint(self) -> str:
        """See :class:`tslam_bench.sources.source.Source`."""
        return f"{FURNITURE_PACKAGE.sha256}:{self.catalogue}:{self.member}:{self.rotation}"

    def load(self, cache: Path) -> SourceMesh:
        """See :class:`tslam_bench.sources.source.Source`."""
        with zipfile.ZipFile(_catalogues(cache) / f"{self.catalogue}.sh3f") as archive:
            data = archive.read(self.member)
        mesh = parse_mesh(data, ".obj")
        if self.rotation is not None:  # prescribed in the y-up frame of the file
            y_up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
            turn = y_up @ np.reshape(self.rotation, (3, 3)) @ y_up.T
            mesh = TriangleMesh(mesh.vertices @ turn.T, mesh.faces)
        mesh, factor = scale_to_hand(mesh, self.name)
        return SourceMesh(
            name=self.name,
            split=self.split,
            category=self.category,
            mesh=mesh,
            source=f"{FURNITURE_PACKAGE.name}: {self.catalogue}: {self.member}",
            license=LICENSES[self.catalogue],
            sha256=hashlib.sha256(data).hexdigest(),
            details={"title": self.title, "creator": self.creator, "scale": factor},
        )


def _data_archive(package: bytes) -> bytes:
    """The ``data.tar`` member (compressed) of a Debian package.

    Raises:
        AssetError: it is not a Debian package.
    """
    if package[:8] != b"!<arch>\n":
        raise AssetError("not a Debian package")
    position = 8
    while position + 60 <= len(package):
        name = package[position : position + 16].decode("ascii", "replace").strip().rstrip("/")
        size = int(package[position + 48 : position + 58])
        if name.startswith("data.tar"):
            return package[position + 60 : position + 60 + size]
        position += 60 + size + size % 2
    raise AssetError("a Debian package without data")


def _catalogues(cache: Path) -> Path:
    """Directory of the package's .sh3f files, unpacked from the pinned package on first use."""
    directory = cache / "downloads" / FURNITURE_PACKAGE.name.removesuffix(".deb")
    if not directory.is_dir():
        data = _data_archive(fetch_file(FURNITURE_PACKAGE, cache).read_bytes())
        with atomic_directory(directory) as temporary, tarfile.open(fileobj=io.BytesIO(data)) as tar:
            for member in tar:
                name = PurePosixPath(member.name).name
                stream = tar.extractfile(member) if name.endswith(".sh3f") or name == "copyright" else None
                if stream is not None:
                    (temporary / name).write_bytes(stream.read())
    return directory


def _entries(path: Path) -> dict[int, dict[str, str]]:
    """The numbered entries of a catalogue."""
    with zipfile.ZipFile(path) as archive:
        text = archive.read(_CATALOGUE).decode("latin-1")
    entries: dict[int, dict[str, str]] = {}
    for line in text.splitlines():
        matched = re.match(r"(\w+)#(\d+)=(.*)", line)
        if matched:
            entries.setdefault(int(matched[2]), {})[matched[1]] = matched[3].encode("latin-1").decode("unicode_escape")
    return entries


def categories() -> list[str]:
    """All categories, in the order in which names are tried."""
    return [category for category, _ in _CATEGORIES]


def category_of(title: str) -> str | None:
    """Category of a model by its name; None if it is left out."""
    lowered = title.lower()
    if re.search(_LEFT_OUT, lowered):
        return None
    return next((category for category, pattern in _CATEGORIES if re.search(pattern, lowered)), None)


def furniture(split: str, cache: Path, per_category: int | None = None) -> list[FurnitureSource]:
    """The models of a split in a fixed, mixed order: one of each category, then the next of each.

    ``per_category`` is the most that one category gives (default: all it has).

    Raises:
        AssetError: the package cannot be fetched or read.
    """
    directory = _catalogues(cache)
    by_category: dict[str, list[FurnitureSource]] = {}
    for catalogue in LICENSES:
        for number, entry in sorted(_entries(directory / f"{catalogue}.sh3f").items()):
            category = category_of(entry.get("name", ""))
            if (
                category is None
                or entry.get("doorOrWindow") == "true"
                or not entry.get("model", "").lower().endswith(".obj")
            ):
                continue
            if (category in VAL_CATEGORIES) != (split == "val"):
                continue
            rotation = tuple(float(x) for x in entry["modelRotation"].split()) if "modelRotation" in entry else None
            by_category.setdefault(category, []).append(
                FurnitureSource(
                    split=split,
                    category=category,
                    catalogue=catalogue,
                    number=number,
                    title=entry["name"],
                    member=entry["model"].lstrip("/"),
                    creator=entry.get("creator", ""),
                    rotation=rotation,
                )
            )
    return list(_in_turn({category: models[:per_category] for category, models in by_category.items()}))


def _in_turn(groups: dict[str, list[FurnitureSource]]) -> Iterator[FurnitureSource]:
    for round_number in range(max(map(len, groups.values()), default=0)):
        for category in sorted(groups):
            if round_number < len(groups[category]):
                yield groups[category][round_number]


def write_attributions(records: list[dict[str, Any]], path: Path) -> None:
    """Writes who made the models of ``records`` and under which licence, as their licences ask."""
    entries = [
        {
            "name": record["name"],
            "title": record["details"].get("title", ""),
            "creator": record["details"].get("creator", ""),
            "license": record["license"],
            "source": record["source"],
            "changes": "made watertight, simplified, rescaled",
        }
        for record in records
        if record["license"] in LICENSES.values()
    ]
    write_json(path, entries)
