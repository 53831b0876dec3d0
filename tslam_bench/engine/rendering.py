"""Whether this machine can render."""

from __future__ import annotations

from functools import cache


@cache
def vulkan_device_available() -> bool:
    """True where SAPIEN finds a Vulkan device (a GPU, or lavapipe on the CPU)."""
    import sapien

    try:
        sapien.render.RenderSystem(sapien.Device("cpu"))
    except RuntimeError:
        try:
            sapien.render.RenderSystem(sapien.Device("cuda"))
        except RuntimeError:
            return False
    return True
