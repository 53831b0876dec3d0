"""Wrong and hostile submissions, score files and meshes: some made by hand, the others by seeded damage to good ones.

The same seed gives the same bytes (but for dates and ids in the COLLADA that trimesh writes). A case made by hand says what has
to become of it.
"""

from __future__ import annotations

import copy
import io
import json
import struct
import sys
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import mesh_mutations
import numpy as np
import trimesh

from tslam_bench.geometry.meshes import TriangleMesh

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from hostile_shapes import slivers

Family = Literal["submission", "score file", "mesh"]
Outcome = Literal["refused", "empty", "accepted"]
PIPE, LINK = b"<pipe>", b"<link>"
"""What stands for a named pipe, and for a link out of the folder, among the files of a case."""
INFO, ROLLOUT, VOLUME, MESH = (
    "submission.json",
    "rollouts/mug/pose0_seed0.npz",
    "reconstructions/mug_1_seed0.npz",
    "reconstructions/mug_1_seed0.ply",
)

Files = dict[str, bytes]
Generator = np.random.Generator


class Case(NamedTuple):
    """One input.

    Attributes:
        family: what it is meant for.
        kind: what was done to it.
        expected: what has to become of it; None where the damage decides.
        files: makes its files: one, or those of a submission's folder.
    """

    family: Family
    kind: str
    expected: Outcome | None
    files: Callable[[], Files]


# --- submissions ------------------------------------------------------------------------------------------------


def npz(compression: int = zipfile.ZIP_DEFLATED, **arrays: Any) -> bytes:
    """An .npz file; values that are bytes are put in as they are."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as archive:
        for name, value in arrays.items():
            if not isinstance(value, bytes):
                array = io.BytesIO()
                np.lib.format.write_array(array, np.asarray(value), allow_pickle=True)
                value = array.getvalue()
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), value, compression)
    return stream.getvalue()


def volume(probability: Any, interpolation: Any = "nearest", **more: Any) -> bytes:
    """A reconstruction as probabilities."""
    if isinstance(probability, np.ndarray) and probability.dtype == np.float64:
        probability = probability.astype(np.float16)
    return npz(probability=probability, interpolation=interpolation, **more)


def ball(resolution: int) -> np.ndarray:
    """Probabilities of a ball: an honest volume."""
    axis = np.linspace(-1, 1, resolution)
    return (np.sum(np.square(np.meshgrid(axis, axis, axis)), axis=0) < 0.1).astype(np.float64)


def checkerboard(resolution: int) -> np.ndarray:
    """As much surface as a volume can have."""
    return (np.indices((resolution,) * 3).sum(axis=0) % 2).astype(np.float64)


def npy(header: str, body: bytes = b"", version: int = 1) -> bytes:
    """An array file with any header."""
    text = header.encode()
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H" if version == 1 else "<I", len(text)) + text + body


def claims(shape: str, dtype: str = "<f2", body: bytes = b"") -> bytes:
    """An array that says more than it holds."""
    return npy(f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}\n", body)


class Spends:
    """Pickles to a call."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (print, ("unpickled",))


def ply(mesh: trimesh.Trimesh) -> bytes:
    """A binary PLY file."""
    return bytes(mesh.export(file_type="ply"))


def ply_text(vertices: str, faces: str, counts: tuple[int, int]) -> bytes:
    """A PLY file with a body of any text."""
    return (
        f"ply\nformat ascii 1.0\nelement vertex {counts[0]}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {counts[1]}\nproperty list uint int vertex_indices\nend_header\n{vertices}{faces}"
    ).encode()


def many_corners(count: int) -> bytes:
    """One polygon of very many corners."""
    head = ply_text("", "", (3, 1)).replace(b"ascii", b"binary_little_endian")
    return head + bytes(3 * 24) + struct.pack("<I", count) + bytes(4 * count)


def moved(scale: float = 1.0, offset: float = 0.0) -> bytes:
    """A ball of 4 cm, scaled and moved (m)."""
    mesh = trimesh.creation.icosphere(2, 0.04)
    return ply(trimesh.Trimesh(scale * mesh.vertices + offset, mesh.faces, process=False))


def spoiled(value: float) -> bytes:
    """A ball with one coordinate that makes no sense."""
    mesh = trimesh.creation.icosphere(2, 0.04)
    vertices = mesh.vertices.copy()
    vertices[7, 1] = value
    lines = "".join(" ".join(map(repr, row)) + "\n" for row in vertices.tolist())
    faces = "".join("3 " + " ".join(map(str, row)) + "\n" for row in mesh.faces.tolist())
    return ply_text(lines, faces, (len(vertices), len(mesh.faces)))


_OPEN = trimesh.creation.icosphere(2, 0.04)
_OPEN.update_faces(np.arange(len(_OPEN.faces)) > 20)

VOLUMES: dict[str, tuple[Outcome, Callable[[], bytes]]] = {
    "honest": ("accepted", lambda: volume(ball(32))),
    "honest, linear": ("accepted", lambda: volume(ball(24), "linear")),
    "Fortran order": ("accepted", lambda: volume(np.asfortranarray(ball(16).astype(np.float16)))),
    "one voxel": ("accepted", lambda: volume(np.ones((1, 1, 1)))),
    "full": ("accepted", lambda: volume(np.ones((32, 32, 32)))),
    "nothing": ("empty", lambda: volume(np.zeros((32, 32, 32)))),
    "one half everywhere": ("accepted", lambda: volume(np.full((32, 32, 32), 0.5))),
    "checkerboard of 256": ("empty", lambda: volume(checkerboard(256))),
    "checkerboard of 256, linear": ("empty", lambda: volume(checkerboard(256), "linear")),
    "checkerboard of 64": ("accepted", lambda: volume(checkerboard(64))),
    "noise of 128": ("accepted", lambda: volume(np.random.default_rng(0).random((128,) * 3))),
    "noise of 128, linear": ("empty", lambda: volume(np.random.default_rng(0).random((128,) * 3), "linear")),
    "not a number": ("refused", lambda: volume(np.full((8, 8, 8), np.nan))),
    "infinite": ("refused", lambda: volume(np.full((8, 8, 8), np.inf))),
    "above one": ("refused", lambda: volume(np.full((8, 8, 8), 1.5))),
    "below zero": ("refused", lambda: volume(np.full((8, 8, 8), -0.5))),
    "too fine": ("refused", lambda: volume(np.zeros((257, 257, 257)))),
    "flat": ("refused", lambda: volume(np.zeros((8, 8)))),
    "a slab": ("refused", lambda: volume(np.zeros((8, 8, 9)))),
    "of no size": ("refused", lambda: volume(np.zeros((0, 0, 0)))),
    "double precision": ("refused", lambda: npz(probability=np.zeros((8, 8, 8)), interpolation="nearest")),
    "big endian": ("refused", lambda: volume(np.zeros((8, 8, 8), dtype=">f2"))),
    "complex": ("refused", lambda: volume(np.zeros((8, 8, 8), dtype=complex))),
    "text": ("refused", lambda: volume(np.full((8, 8, 8), "1"))),
    "another interpolation": ("refused", lambda: volume(ball(8), "cubic")),
    "interpolation is a number": ("refused", lambda: volume(ball(8), 3)),
    "interpolation is long": ("refused", lambda: volume(ball(8), "nearest" + " " * 10_000)),
    "pickled": ("refused", lambda: volume(np.array(Spends(), dtype=object))),
    "an array too many": ("refused", lambda: volume(ball(8), more=1)),
    "without interpolation": ("refused", lambda: npz(probability=ball(8).astype(np.float16))),
    "packed by LZMA": (
        "refused",
        lambda: npz(zipfile.ZIP_LZMA, probability=ball(8).astype("f2"), interpolation="nearest"),
    ),
    "claims a gigabyte": ("refused", lambda: volume(claims("(1024, 1024, 512)"))),
    "claims what it may, holds nothing": ("refused", lambda: volume(claims("(256, 256, 256)"))),
    "claims a size below zero": ("refused", lambda: volume(claims("(-8, -8, 8)"))),
    "claims a size beyond all": ("refused", lambda: volume(claims(f"({10**30}, 8, 8)"))),
    "a header of a gibibyte": ("refused", lambda: volume(npy("{" + " " * 2**20, version=2).ljust(2**22, b" "))),
    "a header that is a program": ("refused", lambda: volume(npy("__import__('os').abort()\n"))),
    "a header nested deeply": ("refused", lambda: volume(npy("(" * 3000 + "\n"))),
    "more bytes than it says": ("refused", lambda: volume(claims("(8, 8, 8)", body=bytes(2 * 512 + 1)))),
    "not an archive": ("refused", lambda: b"probability"),
    "a bare array": ("refused", lambda: claims("(8, 8, 8)", body=bytes(1024))),
}
"""Contents of a reconstruction's .npz."""

MESHES: dict[str, tuple[Outcome, Callable[[], bytes]]] = {
    "honest": ("accepted", lambda: moved()),
    "far away": ("empty", lambda: moved(offset=1.0)),
    "as small as dust": ("accepted", lambda: moved(1e-4)),
    "as large as a house": ("empty", lambda: moved(200.0)),
    "open": ("empty", lambda: ply(_OPEN)),
    "inside out": ("empty", lambda: ply(trimesh.Trimesh(_OPEN.vertices, _OPEN.faces[:, ::-1], process=False))),
    "no faces": ("empty", lambda: ply_text("0 0 0\n", "", (1, 0))),
    "nothing at all": ("empty", lambda: ply_text("", "", (0, 0))),
    "one triangle": ("empty", lambda: ply_text("0 0 0\n1 0 0\n0 1 0\n", "3 0 1 2\n", (3, 1))),
    "both sides of one triangle": ("empty", lambda: ply_text("0 0 0\n1 0 0\n0 1 0\n", "3 0 1 2\n3 0 2 1\n", (3, 2))),
    "a corner that is not there": ("refused", lambda: ply_text("0 0 0\n1 0 0\n0 1 0\n", "3 0 1 9\n", (3, 1))),
    "a corner below zero": ("refused", lambda: ply_text("0 0 0\n1 0 0\n0 1 0\n", "3 0 1 -1\n", (3, 1))),
    "a face of two corners": ("refused", lambda: ply_text("0 0 0\n1 0 0\n0 1 0\n", "2 0 1\n", (3, 1))),
    "words": ("refused", lambda: ply_text("zero one two\n", "", (1, 0))),
    "fewer than it says": ("refused", lambda: ply_text("0 0 0\n", "", (10, 0))),
    "more than it says": ("refused", lambda: ply_text("0 0 0\n1 1 1\n", "", (1, 0))),
    "says a billion": ("refused", lambda: ply_text("0 0 0\n", "", (10**9, 0))),
    "a polygon of 15 million corners": ("refused", lambda: many_corners(15_000_000)),
    "a polygon that says 4 billion": ("refused", lambda: many_corners(3)[:-16] + b"\xff\xff\xff\xff" + bytes(12)),
    "a picture": ("refused", lambda: b"\x89PNG\r\n\x1a\n" + bytes(1000)),
    "a header without end": ("refused", lambda: b"ply\nformat ascii 1.0\n" + b"comment x\n" * 100_000),
}
"""Contents of a reconstruction's .ply whose outcome is known."""
MONSTERS: dict[str, Callable[[], bytes]] = {
    "a coordinate not a number": lambda: spoiled(np.nan),
    "a coordinate infinite": lambda: spoiled(np.inf),
    "a coordinate of 1e30": lambda: spoiled(1e30),
    "a coordinate of 1e300": lambda: spoiled(1e300),
    "a coordinate of 1e-320": lambda: spoiled(1e-320),
    "2,000 slivers": lambda: ply(slivers(2_000)),
    "20,000 slivers": lambda: ply(slivers(20_000)),
    "a million triangles": lambda: ply(trimesh.creation.icosphere(8, 0.05)),
    "all corners in one place": lambda: ply_text("0 0 0\n" * 4, "3 0 1 2\n3 0 2 3\n3 0 3 1\n3 1 3 2\n", (4, 4)),
}
"""Meshes that cost much, or that make no sense: anything but a crash."""


def _info(base: Files, **changes: Any) -> Callable[[], bytes]:
    def made() -> bytes:
        value = json.loads(base[INFO])
        for name, new in changes.items():
            value[name] = new
        return json.dumps(value).encode()

    return made


def infos(base: Files) -> dict[str, tuple[Outcome, Callable[[], bytes]]]:
    """Contents of submission.json."""
    plain = base[INFO]
    accepted: dict[str, Any] = {
        "markup of a terminal": {"method": "Ours [/w noise] [bold]x[/bold]"},
        "markup of a page": {"method": "<script>alert(1)</script>", "label": '"><img src=x onerror=alert(1)>'},
        "names of all scripts": {"authors": ["ज़फ़र", "م‌حمد", "山田\u3000太郎", "👩\u200d🔬"]},
        "text that runs backwards": {"method": "mine \u202eevil\u202c", "label": "\u2066x\u2069"},
        "calls itself a baseline": {"explorer": "heuristic"},
        "formula of a spreadsheet": {"method": '=HYPERLINK("http://x")'},
        "template of a page": {"method": "{{ 7 * 7 }}{% raw %}"},
    }
    refused: dict[str, Any] = {
        "talks to the terminal": {"method": "\x1b]0;owned\x07\x1b[2J"},
        "two lines": {"method": "a\nb"},
        "400 digits": {"training": {"steps": 10**400, "wall_time_hours": 1, "hardware": ""}},
        "a link that is a program": {"link": "javascript:alert(1)"},
        "a path as explorer": {"explorer": "../../etc/passwd"},
        "hides that it is privileged": {"explorer": "oracle"},
        "a seed too many": {"seeds": list(range(101))},
        "another seed": {"seeds": [3]},
        "unknown field": {"rank": 1},
        "of another task": {"environment_id": "TactileSLAM-Tabletop-v0"},
    }
    texts: dict[str, bytes] = {
        "empty": b"",
        "not JSON": b"method: mine",
        "a list": b"[]",
        "nested deeply": b'{"method":' * 20_000,
        "a key twice": plain.replace(b"{", b'{"method": "a", ', 1),
        "not a number": plain.replace(b"false", b"NaN", 1),
        "UTF-16": plain.decode().encode("utf-16"),
        "half a character": plain.replace(b"{", b'{"label": "\\ud800", ', 1),
        "too large": plain + b" " * 70_000,
    }
    found: dict[str, tuple[Outcome, Callable[[], bytes]]] = {}
    found |= {kind: ("accepted", _info(base, **changes)) for kind, changes in accepted.items()}
    found |= {kind: ("refused", _info(base, **changes)) for kind, changes in refused.items()}
    found |= {kind: ("refused", lambda text=text: text) for kind, text in texts.items()}
    found["a byte-order mark"] = ("accepted", lambda: b"\xef\xbb\xbf" + plain)
    return found


def folders(base: Files) -> dict[str, tuple[Outcome, Files]]:
    """What lies in the folder, or what the archive is."""
    packed = mesh_mutations.zipped(base)
    link = zipfile.ZipInfo(VOLUME)
    link.external_attr = 0o120777 << 16
    linked = io.BytesIO()
    with zipfile.ZipFile(linked, "w") as archive:
        archive.writestr(INFO, base[INFO])
        archive.writestr(link, "/etc/passwd")
    return {
        "as it is": ("accepted", base),
        "an archive": ("accepted", {"s.zip": packed}),
        "an archive in a folder": (
            "accepted",
            {"s.zip": mesh_mutations.zipped({f"mine/{k}": v for k, v in base.items()})},
        ),
        "backslashes": (
            "accepted",
            {"s.zip": mesh_mutations.zipped({f".\\{k}".replace("/", "\\"): v for k, v in base.items()})},
        ),
        "litter": ("accepted", base | {"desktop.ini": b"x", "rollouts/.DS_Store": b"x", "README.md": b"x"}),
        "without submission.json": ("refused", {k: v for k, v in base.items() if k != INFO}),
        "without rollouts": ("empty", {k: v for k, v in base.items() if k != ROLLOUT}),
        "without reconstructions": ("empty", {k: v for k, v in base.items() if k != VOLUME}),
        "only submission.json": ("empty", {INFO: base[INFO]}),
        "a program beside it": ("refused", base | {"run.sh": b"rm -rf /"}),
        "a volume and a mesh": ("refused", base | {MESH: moved()}),
        "another object": ("refused", base | {VOLUME.replace("mug", "teacup"): base[VOLUME]}),
        "a train object": ("refused", base | {VOLUME.replace("mug", "carton-3"): base[VOLUME]}),
        "pose 8": ("refused", base | {ROLLOUT.replace("pose0", "pose8"): base[ROLLOUT]}),
        "a rollout in the place of another": ("accepted", base | {ROLLOUT.replace("pose0", "pose2"): base[ROLLOUT]}),
        "a pipe as volume": ("refused", base | {VOLUME: PIPE}),
        "a pipe as submission.json": ("refused", base | {INFO: PIPE}),
        "a link as volume": ("refused", base | {VOLUME: LINK}),
        "an empty archive": ("refused", {"s.zip": mesh_mutations.zipped({})}),
        "an archive that escapes": ("refused", {"s.zip": mesh_mutations.zipped(base | {"../../x": b""})}),
        "an archive with an absolute path": ("refused", {"s.zip": mesh_mutations.zipped(base | {"/tmp/x": b""})}),
        "an archive with a drive": ("refused", {"s.zip": mesh_mutations.zipped(base | {"C:\\x": b""})}),
        "an archive with a link": ("refused", {"s.zip": linked.getvalue()}),
        "an archive in an archive": ("refused", {"s.zip": mesh_mutations.zipped({"s.zip": packed})}),
        "an archive of very many files": (
            "refused",
            {"s.zip": mesh_mutations.zipped({f"{k}": b"" for k in range(60_000)}, zipfile.ZIP_STORED)},
        ),
        "a bomb": ("refused", {"s.zip": mesh_mutations.zipped(base | {VOLUME: bytes(300_000_000)})}),
        "an archive packed by LZMA": ("refused", {"s.zip": mesh_mutations.zipped(base, zipfile.ZIP_LZMA)}),
        "an archive without its end": ("refused", {"s.zip": packed[:-30]}),
        "a text named zip": ("refused", {"s.zip": b"PK\x03\x04 not"}),
    }


def rollouts(base: Files) -> dict[str, tuple[Outcome, Callable[[], bytes]]]:
    """Contents of a rollout."""
    good = dict(np.load(io.BytesIO(base[ROLLOUT])))

    def with_(**changes: Any) -> Callable[[], bytes]:
        return lambda: npz(**{k: v for k, v in (good | changes).items() if v is not None})

    steps = good["touched_step"]
    found: dict[str, tuple[Outcome, Callable[[], bytes]]] = {
        "actions not numbers": ("refused", with_(actions=np.full_like(good["actions"], np.nan))),
        "actions out of range": ("refused", with_(actions=good["actions"] + 2)),
        "actions of another hand": ("refused", with_(actions=good["actions"][:, :16])),
        "joints not numbers": ("refused", with_(joint_checkpoints=np.full_like(good["joint_checkpoints"], np.inf))),
        "steps too late": ("refused", with_(touched_step=np.where(steps >= 0, np.int16(200), steps))),
        "steps before the first": ("refused", with_(touched_step=np.where(steps >= 0, steps, np.int16(-2)))),
        "touched without a step": ("refused", with_(touched_step=np.full_like(steps, -1))),
        "without actions": ("refused", with_(actions=None)),
        "of another format": ("refused", with_(format=np.int16(99))),
        "an array too many": ("refused", with_(reward=np.zeros(3))),
        "pickled": ("refused", with_(actions=np.array(Spends(), dtype=object))),
        "claims a terabyte": ("refused", with_(actions=claims(f"({10**9}, 28)", "<f4"))),
        "touches everywhere": (
            "accepted",
            with_(touched=np.full_like(good["touched"], 255), touched_step=np.zeros_like(steps)),
        ),
    }
    return found


STRANGE: tuple[Any, ...] = (None, True, "x", -1, 2.5, 1e300, 10**400, [], {}, [[]], {"a": 1}, "\x1b[2J", "x" * 5000, 0)


def changed_json(data: bytes, generator: Generator) -> bytes:
    """One to three values of a JSON text exchanged for something strange, or left out."""
    value = json.loads(data)
    for _ in range(int(generator.integers(1, 4))):
        spots = list(_places(value))
        parent, key = spots[int(generator.integers(len(spots)))]
        new = STRANGE[int(generator.integers(len(STRANGE)))]
        if new is None:
            del parent[key]
        else:
            parent[key] = copy.deepcopy(new)
        if not value:
            break
    return json.dumps(value).encode()


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield value, key
        yield from _places(value[key])


def submissions(base: Files, count: int, seed: int, costly: bool = True) -> Iterator[Case]:
    """By hand, then ``count`` by damage to the bytes of one of the files, or of the whole archive.

    Args:
        base: files of a good submission of one rollout and one reconstruction.
        costly: with those that take seconds.
    """
    for kind, (expected, files) in folders(base).items():
        yield Case("submission", f"folder: {kind}", expected, lambda files=files: files)
    with_mesh = {name: data for name, data in base.items() if name != VOLUME}
    groups: tuple[tuple[str, str, Files, Mapping[str, tuple[Outcome, Callable[[], bytes]]]], ...] = (
        ("info", INFO, base, infos(base)),
        ("rollout", ROLLOUT, base, rollouts(base)),
        ("volume", VOLUME, base, VOLUMES),
        ("mesh", MESH, with_mesh, MESHES),
    )
    for group, name, files, contents in groups:
        for kind, (expected, make) in contents.items():
            if costly or not ("256" in kind or "128" in kind or "million" in kind):
                yield Case("submission", f"{group}: {kind}", expected, _one(files, name, make))
    for kind, make in MONSTERS.items():
        if costly or not ("20,000" in kind or "million" in kind):
            yield Case("submission", f"mesh: {kind}", None, _one(with_mesh, MESH, make))
    kinds = list(mesh_mutations.BYTES)
    targets = (INFO, ROLLOUT, VOLUME, MESH, "s.zip")
    meshed = with_mesh | {MESH: moved()}
    for index in range(count):
        target = targets[index % len(targets)]
        files = meshed if target == MESH else base
        kind = kinds[(index // len(targets)) % len(kinds)]
        yield Case(
            "submission",
            f"{target}: {kind}",
            None,
            _damaged(files, target, mesh_mutations.BYTES[kind], (seed, 1, index)),
        )
        if index % 5 == 0:
            yield Case(
                "submission", "info: values exchanged", None, _damaged(base, INFO, changed_json, (seed, 1, index))
            )


def _one(files: Files, name: str, make: Callable[[], bytes]) -> Callable[[], Files]:
    return lambda: files | {name: make()}


def _damaged(
    files: Files, target: str, damage: Callable[[bytes, Generator], bytes], seed: tuple[int, ...]
) -> Callable[[], Files]:
    def made() -> Files:
        generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
        if target == "s.zip":
            return {target: damage(mesh_mutations.zipped(files), generator)}
        return files | {target: damage(files[target], generator)}

    return made


# --- score files ------------------------------------------------------------------------------------------------


def score_files(base: bytes, count: int, seed: int) -> Iterator[Case]:
    """By hand, then ``count`` by damage to the bytes of a good file, and as many by exchanging values."""
    good = json.loads(base)

    def case(kind: str, expected: Outcome, data: bytes) -> Case:
        return Case("score file", kind, expected, lambda: {"score.json": data})

    def with_(**changes: Any) -> bytes:
        return json.dumps({k: v for k, v in (good | changes).items() if v is not None}).encode()

    def about(**changes: Any) -> bytes:
        return with_(submission=good["submission"] | changes)

    def result(**changes: Any) -> bytes:
        return with_(results=[good["results"][0] | changes])

    perfect = {group: {k: {**v, "mean": 2.0} for k, v in rows.items()} for group, rows in good["aggregate"].items()}
    at = good["results"][0]["poses"]
    yield case("as it is", "accepted", base)
    yield case("says it is verified", "accepted", with_(verified=True, own_run=True))
    yield case("says it is sealed", "accepted", with_(verified=True, seal="0" * 64))
    yield case("a mean of two", "accepted", with_(aggregate=perfect))
    yield case("no aggregate that is one", "accepted", with_(aggregate=[1]))
    yield case("markup", "accepted", about(method="Ours [/w noise]", label="<script>alert(1)</script>"))
    yield case("calls itself a baseline", "accepted", about(explorer="heuristic"))
    yield case("notes of a stranger", "accepted", with_(notes=["\u202e[red]x", "replayed here: 8 of 8"]))
    for kind, data in {
        "empty": b"",
        "a list": b"[]",
        "a number": b"7",
        "of another version": with_(score_version=1),
        "without a version": with_(score_version=None),
        "without results": with_(results=None),
        "no results": with_(results=[]),
        "results twice": with_(results=good["results"] * 2),
        "a result of another object": result(object="hammer"),
        "a result of another seed": result(seed=5),
        "an IoU above one": result(poses=at | {"8": at["8"] | {"iou": 1.5}}),
        "an IoU below zero": result(poses=at | {"8": at["8"] | {"iou": -0.5}}),
        "an IoU in words": result(poses=at | {"8": at["8"] | {"iou": "1.0"}}),
        "an IoU that is true": result(poses=at | {"8": at["8"] | {"iou": True}}),
        "an IoU of 400 digits": result(poses=at | {"8": at["8"] | {"iou": 10**400}}),
        "no IoU": result(poses=at | {"8": {k: v for k, v in at["8"].items() if k != "iou"}}),
        "after 16 poses": result(poses=at | {"16": at["8"]}),
        "a short curve": result(recall_curve=[0.0, 1.0]),
        "a very long curve": result(recall_curve=[0.5] * 100_000),
        "a curve of words": result(recall_curve=["0"] * len(good["results"][0]["recall_curve"])),
        "an object twice": with_(objects=["mug", "mug"]),
        "a path as object": with_(objects=["../mug"]),
        "no objects": with_(objects=[]),
        "a hash that is none": with_(content_hash="../../index.html"),
        "verified in words": with_(verified="yes"),
        "a note of a megabyte": with_(notes=["x" * 2**20]),
        "a million notes": with_(notes=["x"] * 10**6),
        "a method that talks to the terminal": about(method="\x1b[2J"),
        "a link that is a program": about(link="javascript:alert(1)"),
        "an unknown field": with_(rank=1),
        "a key twice": base.replace(b"{", b'{"verified": true, ', 1),
        "not a number": base.replace(b"false", b"NaN", 1),
        "beyond all numbers": base.replace(b"false", b"1e999", 1),
        "a number of 5000 digits": base.replace(b"false", b"1" * 5000, 1),
        "nested deeply": b"[" * 200_000,
        "half a character": with_(package_version="\ud800"),
        "UTF-16": base.decode().encode("utf-16"),
        "a pipe": PIPE,
    }.items():
        yield case(kind, "refused", data)
    for index in range(count):
        kind = list(mesh_mutations.BYTES)[index % len(mesh_mutations.BYTES)]
        yield Case(
            "score file",
            kind,
            None,
            _damaged({"score.json": base}, "score.json", mesh_mutations.BYTES[kind], (seed, 2, index)),
        )
        yield Case(
            "score file",
            "values exchanged",
            None,
            _damaged({"score.json": base}, "score.json", changed_json, (seed, 3, index)),
        )


# --- meshes to import -------------------------------------------------------------------------------------------

HARMLESS = ("chain.glb", "count.dae", "outside.obj", "parents.glb", "views.glb")
"""Files of ``mesh_mutations.HOSTILE`` that overstate or repeat what is not used, or name a file that is not read: they are taken
for what they hold."""


def meshes(good: list[tuple[str, TriangleMesh]], count: int, seed: int) -> Iterator[Case]:
    """By hand, then ``count`` mutants of good meshes in all formats; the file's own name comes first."""
    for name, content in mesh_mutations.HOSTILE.items():
        files = content if isinstance(content, dict) else {name: content}
        first = {name: files[name], **files}
        yield Case("mesh", name, "accepted" if name in HARMLESS else "refused", lambda first=first: first)
    yield Case("mesh", "a pipe", "refused", lambda: {"pipe.stl": PIPE})
    made = 0
    index = 0
    while made < count:
        item = mesh_mutations.mutant(good, index, seed)
        index += 1
        if item.kind != "hostile":
            made += 1
            first = {item.name: item.files[item.name], **item.files}
            yield Case("mesh", item.kind, None, lambda first=first: first)
