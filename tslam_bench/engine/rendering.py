"""Whether this machine can render, and one line where it cannot."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Final

from tslam_bench.errors import AssetError, InvalidInputError

RENDER_MODES: Final = ("rgb_array", "human", "sensors", "all")
NO_VULKAN: Final = (
    "no Vulkan device; install a GPU driver, or Mesa 25's lavapipe for rendering on the CPU "
    "(tslam-bench doctor tells how)"
)
_TEXTURES: Final = ("rgb", "depth", "segmentation", "position", "normal", "albedo")
_PICTURES: Final = (*_TEXTURES, "rgbd", "sensor_data", "pointcloud")
_STATES: Final = ("state_dict", "state", "none")


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


def choose_backend(obs_mode: Any, render_mode: Any, backend: Any) -> Any:
    """The ``render_backend`` for these modes: none unless pictures are asked for and can be made.

    A ``render_mode`` alone does no harm where nothing can be rendered: ``render()`` says so when it is called.

    Raises:
        InvalidInputError: an unknown mode.
        AssetError: pictures are observed, a window or a backend is asked for, and there is no Vulkan device.
    """
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise InvalidInputError(f"render_mode {render_mode!r}: unknown; choose one of {', '.join(RENDER_MODES)}")
    wanted = None
    if obs_mode is not None and _observes_pictures(obs_mode):
        wanted = f"obs_mode {obs_mode!r}"
    elif render_mode == "human":
        wanted = "render_mode 'human'"
    elif backend not in ("auto", "none"):
        wanted = f"render_backend {backend!r}"
    if wanted is None:
        return "gpu" if render_mode is not None and backend == "auto" and vulkan_device_available() else "none"
    if not vulkan_device_available():
        raise AssetError(f"{wanted}: {NO_VULKAN}")
    if backend == "none":
        raise InvalidInputError(f"{wanted}: render_backend 'none' makes no pictures; leave it out")
    return "gpu" if backend == "auto" else backend


def _observes_pictures(obs_mode: Any) -> bool:
    parts = obs_mode.split("+") if isinstance(obs_mode, str) else [obs_mode]
    if not all(part in (*_STATES, *_PICTURES) for part in parts):
        known = ", ".join((*_STATES, *_PICTURES))
        raise InvalidInputError(f"obs_mode {obs_mode!r}: unknown; choose one of {known}, or several joined by '+'")
    return any(part in _PICTURES for part in parts)


if TYPE_CHECKING:
    from mani_skill.envs.sapien_env import BaseEnv as _Base
else:
    _Base = object


class OneLineRendering(_Base):
    """Mixin before ManiSkill's environment: its methods of rendering, with one line where there is nothing to render with."""

    def render(self) -> Any:
        """A picture, or a viewer; see ``render_mode``. Raises InvalidInputError if none was given."""
        if self.render_mode is None:
            raise InvalidInputError(
                "render: no render_mode was given; make the environment with render_mode='rgb_array'"
            )
        return super().render()

    def render_human(self) -> Any:
        """Opens a viewer."""
        self._check_renderer()
        return super().render_human()

    def render_rgb_array(self, *args: Any, **kwargs: Any) -> Any:
        """Pictures (E, height, width, 3) uint8."""
        self._check_renderer()
        return super().render_rgb_array(*args, **kwargs)

    def render_sensors(self) -> Any:
        """What the cameras of the observation see, side by side."""
        self._check_renderer()
        return super().render_sensors()

    def render_all(self) -> Any:
        """Both."""
        self._check_renderer()
        return super().render_all()

    def _check_renderer(self) -> None:
        if not self.scene.can_render():
            if vulkan_device_available():
                raise InvalidInputError("render: made without a renderer; make it with render_mode='rgb_array'")
            raise AssetError(f"render: {NO_VULKAN}")
