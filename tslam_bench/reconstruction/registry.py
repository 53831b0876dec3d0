"""The registered reconstructors: the benchmark's, of which two are floors (protocol sections 9 and 11), and the user's own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from tslam_bench.errors import BenchmarkError, InvalidInputError
from tslam_bench.plugins import Registry, Spec, user_error

if TYPE_CHECKING:  # brings trimesh, and registering has to be quick
    from tslam_bench.reconstruction.volume import Reconstructor, Volume


@dataclass(frozen=True)
class ReconstructorSpec(Spec):
    """One registered reconstructor.

    Attributes:
        needs: ``nothing``, a trained ``model``, prepared training ``objects``; ``own``: the user's, what it likes.
        empty: what it returns when nothing was touched.
    """

    needs: Literal["nothing", "model", "objects", "own"] = "own"
    empty: str = "unknown"


def _built_in(
    identifier: str,
    needs: Literal["nothing", "model", "objects"],
    factory: str,
    summary: str,
    empty: str = "empty",
    **kwargs: Any,
) -> ReconstructorSpec:
    return ReconstructorSpec(identifier, summary, factory, kwargs, needs=needs, empty=empty)


_RECONSTRUCTORS: Final = Registry(
    "reconstructor",
    "tslam_bench.reconstructors",
    (
        _built_in(
            "grid", "nothing", "tslam_bench.reconstruction.grid:GridReconstructor", "the touched voxels as they are"
        ),
        _built_in(
            "hull",
            "nothing",
            "tslam_bench.reconstruction.hull:HullReconstructor",
            "convex hull of the touched voxel centres",
        ),
        _built_in(
            "carve",
            "nothing",
            "tslam_bench.reconstruction.carve:CarveReconstructor",
            "the hull without the free space that was swept",
        ),
        _built_in(
            "ifnet",
            "model",
            "tslam_bench.reconstruction.trained:load_reconstructor",
            "IF-Net: implicit function in multi-scale features, with free space",
            name="ifnet",
        ),
        _built_in(
            "convonet",
            "model",
            "tslam_bench.reconstruction.trained:load_reconstructor",
            "convolutional occupancy network: a U-Net's features, with free space",
            name="convonet",
        ),
        _built_in(
            "unet",
            "model",
            "tslam_bench.reconstruction.trained:load_reconstructor",
            "U-Net on folded grids: output of twice the grid's resolution, surface at the best expected IoU",
            name="unet",
        ),
        _built_in(
            "mean_shape",
            "objects",
            "tslam_bench.reconstruction.priors:load_mean_shape",
            "mean of the training solids, whatever was touched",
            empty="the mean shape",
        ),
        _built_in(
            "retrieval",
            "objects",
            "tslam_bench.reconstruction.priors:load_retrieval",
            "training shape, in 24 rotations, that agrees best with the grids",
        ),
    ),
    ReconstructorSpec,
)


def register_reconstructor(id: str, factory: str | Callable[..., Reconstructor], *, summary: str = "") -> None:
    """Makes a reconstructor of your own known under an id, in every process that runs this line.

    Args:
        id: at most 64 of a-z, 0-9, ``_``, ``.``, ``-``; also names folders and the reconstructor of submissions.
        factory: class, or function that returns a reconstructor (an object with the method ``reconstruct`` of
            :class:`tslam_bench.reconstruction.volume.Reconstructor`), or ``module:name`` of one. It is called with the
            arguments that were asked for and, if one was given, ``model=PATH``.
        summary: one line for listings.

    Raises:
        InvalidInputError: not an id, or one of the benchmark's own.
    """
    _RECONSTRUCTORS.register(ReconstructorSpec(id, summary, factory))


def list_reconstructors() -> tuple[ReconstructorSpec, ...]:
    """All registered reconstructors, in the order of the documentation, then the user's own."""
    return _RECONSTRUCTORS.all()


def get_reconstructor(reconstructor: Any) -> ReconstructorSpec:
    """The spec of an id, of ``module:name``, of a class or function, or of a reconstructor itself.

    Raises:
        InvalidInputError: unknown id (the message lists the known ones).
    """
    return _RECONSTRUCTORS.get(reconstructor)


def make_reconstructor(
    reconstructor: Any,
    model: Path | None = None,
    split: str = "train",
    cache: Path | None = None,
    threads: int = 1,
    objects: Sequence[str] = (),
) -> Reconstructor:
    """Builds a reconstructor.

    Args:
        reconstructor: see :func:`get_reconstructor`.
        model: checkpoint or weights, for those that need a model; None: the shipped weights. The user's own get the path.
        split: split whose prepared objects ``mean_shape`` and ``retrieval`` are built from.
        cache: asset cache, default the user's.
        threads: torch threads of the benchmark's learned ones.
        objects: build from these objects of the split; empty: all that are prepared.

    Raises:
        InvalidInputError: unknown name; a model missing, unreadable, of another architecture, or given in vain; the test
            split; something that is not a reconstructor.
        AssetError: no prepared object in the split, or a corrupt one.
        UserCodeError: the user's code raised something.
    """
    spec = get_reconstructor(reconstructor)
    if spec.needs == "model" and model is None:
        model = shipped_weights(spec.id)
    if spec.needs == "model" and model is None:
        raise InvalidInputError(
            f"reconstructor {spec.id!r}: needs a model; train one with "
            f"`tslam-bench reconstruct train --architecture {spec.id} --output FILE`"
        )
    given: dict[str, Any] = {} if model is None else {"model": model}
    if spec.needs == "model":
        given["threads"] = threads
    elif spec.needs == "objects":
        given |= {"split": split, "cache": cache, "objects": objects}
    made = _RECONSTRUCTORS.make(spec, given, ("reconstruct",))
    return _CheckedReconstructor(made, _RECONSTRUCTORS.label(spec)) if spec.needs == "own" else made


def reconstructor_source(reconstructor: Any, model: Path | None, objects: Sequence[str] = ()) -> dict[str, Any]:
    """What a reconstructor's results depend on: see :meth:`tslam_bench.plugins.Registry.source`."""
    spec = get_reconstructor(reconstructor)
    if spec.needs == "model" and model is None:
        model = shipped_weights(spec.id)
    arguments = {"objects": list(objects)} if spec.needs == "objects" else {}
    return _RECONSTRUCTORS.source(spec, arguments, model)


def shipped_weights(identifier: str) -> Path | None:
    """The file of weights that the package brings for a reconstructor, or None."""
    path = Path(__file__).parent / "shipped" / f"{identifier}.safetensors"
    return path if path.is_file() else None


class _CheckedReconstructor:
    """A reconstructor of the user's whose answers are checked; ``label`` is what messages call it."""

    def __init__(self, reconstructor: Reconstructor, label: str) -> None:
        self.name = getattr(reconstructor, "name", type(reconstructor).__name__)
        self._reconstructor, self._label = reconstructor, label

    def reconstruct(self, touched: Any, visited: Any) -> Volume:
        """See :class:`tslam_bench.reconstruction.volume.Reconstructor`.

        Raises:
            InvalidInputError: the user's returned no volume, or one that cannot be.
            UserCodeError: it raised something.
        """
        from tslam_bench.reconstruction.volume import Volume

        try:
            volume = self._reconstructor.reconstruct(touched.copy(), visited.copy())
        except BenchmarkError as error:
            raise InvalidInputError(f"{self._label}: {error}") from error
        except Exception as error:
            raise user_error(error, f"{self._label}: reconstruct") from error
        if not isinstance(volume, Volume):
            raise InvalidInputError(
                f"{self._label}: reconstruct returned a {type(volume).__name__}, expected a Volume; "
                "wrap the (R, R, R) probabilities: tslam_bench.reconstruction.volume.Volume(probability)"
            )
        return volume
