"""TactileSLAM benchmark: a blind robot hand explores an unknown object and rebuilds its shape."""

__version__ = "0.1.0"
