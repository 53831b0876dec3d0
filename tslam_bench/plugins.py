"""Doors for the user's own code: what an id stands for, ``module:Class``, ``path/to/file.py:Class``, and entry points.

One :class:`Registry` holds the policies (:mod:`tslam_bench.evaluation.policies`) and one the reconstructors
(:mod:`tslam_bench.reconstruction.registry`). The benchmark's own are registered by string too, so that nothing is imported before
it is made. A mistake in the user's code is named in one line, and whatever that code raises keeps its traceback.
"""

from __future__ import annotations

import difflib
import hashlib
import importlib
import importlib.metadata
import importlib.util
import inspect
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial, reduce
from pathlib import Path
from types import ModuleType
from typing import Any, Final, Generic, TypeVar

from tslam_bench.errors import BenchmarkError, InvalidInputError, UserCodeError
from tslam_bench.files import sha256_file

IDENTIFIER: Final = re.compile(r"[a-z0-9][a-z0-9_.-]{0,63}")
"""Ids of policies and reconstructors, in commands, folders and submissions."""


@dataclass(frozen=True)
class Spec:
    """What is registered under an id.

    Attributes:
        id: identifier, see :data:`IDENTIFIER`.
        summary: one line for listings.
        factory: class or function that makes it, or ``module:name`` of one; None if there is nothing to make.
        kwargs: arguments that the factory is always called with.
        reference: what the user wrote instead of an id, such as ``mypkg:MyPolicy``; empty for a registered one.
    """

    id: str
    summary: str = ""
    factory: str | Callable[..., Any] | None = None
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    reference: str = ""

    def row(self) -> dict[str, Any]:
        """The fields that listings show."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("factory", "kwargs", "reference")}


S = TypeVar("S", bound=Spec)


class Registry(Generic[S]):
    """Specs by id: built-in ones, those that the process has registered, and those of installed packages.

    Args:
        kind: what they are, for messages: ``policy``.
        group: entry-point group in which other packages name theirs.
        built_in: in the order of the documentation.
        own: makes the spec of a user's own from the fields of :class:`Spec`.
    """

    def __init__(self, kind: str, group: str, built_in: Sequence[S], own: Callable[..., S]) -> None:
        self.kind, self._group, self._own = kind, group, own
        self._built_in = {spec.id: spec for spec in built_in}
        self._registered: dict[str, S] = {}

    def register(self, spec: S) -> None:
        """Adds ``spec``; an earlier one of the user's under the same id is replaced.

        Raises:
            InvalidInputError: the id is not an identifier, or is one of the benchmark's own.
        """
        self._check_id(spec.id)
        if spec.id in self._built_in:
            raise InvalidInputError(f"{self.kind} {spec.id!r}: is the benchmark's own; choose another id")
        self._registered[spec.id] = spec

    def all(self) -> tuple[S, ...]:
        """All specs: the benchmark's in the order of the documentation, then the user's."""
        return tuple({**self._installed(), **self._registered, **self._built_in}[name] for name in self._ids())

    def get(self, wanted: Any) -> S:
        """The spec of an id, of ``module:name``, of a class or function, or of a policy or reconstructor that is already made.

        Raises:
            InvalidInputError: unknown id (the message lists the known ones), or an entry point that cannot be one.
        """
        if not isinstance(wanted, str):
            ready = not (isinstance(wanted, type | partial) or inspect.isroutine(wanted))
            named = type(wanted) if ready else wanted
            name = getattr(named, "__qualname__", type(named).__name__)
            reference = f"{getattr(named, '__module__', '')}:{name}"
            return self._own(
                id=identifier_of(reference), reference=reference, factory=_Made(wanted) if ready else wanted
            )
        if ":" in wanted:
            return self._own(id=identifier_of(wanted), reference=wanted, factory=wanted)
        known = self._built_in.get(wanted) or self._registered.get(wanted) or self._installed().get(wanted)
        if known is None:
            ids = ", ".join(self._ids())
            raise InvalidInputError(f"{self.kind} {wanted!r}: unknown; choose one of {ids}, or give module:Class")
        self._check_id(known.id)
        return known

    def make(self, spec: S, arguments: Mapping[str, Any], methods: Sequence[str]) -> Any:
        """Calls the factory of ``spec`` with its own and the given keyword arguments.

        Raises:
            InvalidInputError: it cannot be found, does not take the arguments, or makes something without ``methods``.
            UserCodeError: the user's code raised something.
        """
        assert spec.factory is not None
        label = self.label(spec)
        factory = load(spec.factory, label) if isinstance(spec.factory, str) else spec.factory
        if not callable(factory):
            raise InvalidInputError(f"{label}: is neither a class nor a function that makes one")
        given = {**arguments, **spec.kwargs}
        _check_arguments(factory, given, label)
        try:
            made = factory(**given)
        except BenchmarkError:
            raise
        except Exception as error:
            raise user_error(error, f"{label}: making it") from error
        if isinstance(made, type):
            raise InvalidInputError(f"{label}: returned the class {made.__name__}, expected an instance; call it")
        for method in methods:
            if not callable(getattr(made, method, None)):
                remedy = f"see help(tslam_bench.register_{self.kind})"
                raise InvalidInputError(f"{label}: {type(made).__name__} has no method {method}; {remedy}")
        return made

    def label(self, spec: S) -> str:
        """What messages call it."""
        return f"{self.kind} {spec.reference or spec.id!r}"

    def source(self, spec: S, arguments: Mapping[str, Any], model: Path | None) -> dict[str, Any]:
        """What the results of a policy or reconstructor depend on: id, arguments, model, and the file of its class or function.

        Raises:
            InvalidInputError: there is no such class, or an argument that JSON cannot hold.
        """
        try:
            recorded = json.loads(json.dumps(dict(arguments), allow_nan=False))
        except (TypeError, ValueError) as error:
            raise InvalidInputError(
                f"{self.label(spec)}: its arguments cannot be recorded as JSON ({error})"
            ) from error
        return {
            self.kind: spec.reference or spec.id,
            "arguments": recorded,
            "model_sha256": None if model is None else content_sha256(model),
            "code_sha256": None if spec.id in self._built_in else self._code_sha256(spec),
        }

    def _code_sha256(self, spec: S) -> str | None:
        factory = load(spec.factory, self.label(spec)) if isinstance(spec.factory, str) else spec.factory
        try:
            file = inspect.getsourcefile(type(factory.made) if isinstance(factory, _Made) else factory)  # type: ignore[arg-type]
        except TypeError:  # made in C, or in a console
            return None
        return sha256_file(Path(file)) if file and Path(file).is_file() else None

    def _installed(self) -> dict[str, S]:
        """Specs that installed packages name as entry points."""
        found = importlib.metadata.entry_points(group=self._group)
        return {e.name: self._own(id=e.name, summary=f"entry point {e.value}", factory=e.value) for e in found}

    def _check_id(self, identifier: str) -> None:
        if not IDENTIFIER.fullmatch(identifier):
            raise InvalidInputError(f"{self.kind} {identifier!r}: use at most 64 of a-z, 0-9, '_', '.', '-' as its id")

    def _ids(self) -> list[str]:
        return list(dict.fromkeys([*self._built_in, *self._registered, *sorted(self._installed())]))


@dataclass(frozen=True)
class _Made:
    """Factory of what is already made."""

    made: Any

    def __call__(self) -> Any:
        return self.made


def identifier_of(reference: str) -> str:
    """An id for ``module:Class`` or ``path/to/file.py:Class``: ``mypkg:MyPolicy`` is ``mypkg.mypolicy``.

    A class of the script that runs has its own name alone.
    """
    where, _, name = reference.rpartition(":")
    where = Path(where).stem if where.endswith(".py") else where
    full = name if where == "__main__" else f"{where}.{name}"
    text = re.sub(r"[^a-z0-9_.-]+", "-", full.lower()).strip("-_.")
    return text[-64:].lstrip("-_.") or "unnamed"


def load(reference: str, label: str) -> Any:
    """What ``module:name`` or ``path/to/file.py:name`` names.

    Args:
        reference: the name may have dots.
        label: what messages begin with.

    Raises:
        InvalidInputError: there is no such file, module or name.
        UserCodeError: importing the module raised something.
    """
    where, _, name = reference.rpartition(":")
    if not where or not all(part.isidentifier() for part in name.split(".")):
        raise InvalidInputError(f"{label}: give module:Class, or path/to/file.py:Class")
    try:
        module = _file_module(Path(where), label) if where.endswith(".py") else importlib.import_module(where)
    except BenchmarkError:
        raise
    except ModuleNotFoundError as error:
        if error.name and (where == error.name or where.startswith(f"{error.name}.")):
            raise InvalidInputError(
                f"{label}: there is no module {error.name}; install it, or run in the folder that holds it"
            ) from error
        raise user_error(error, f"{label}: importing {where}") from error
    except Exception as error:
        raise user_error(error, f"{label}: importing {where}") from error
    try:
        return reduce(getattr, name.split("."), module)
    except AttributeError:
        near = difflib.get_close_matches(name, [n for n in vars(module) if not n.startswith("_")], n=1)
        remedy = f"; did you mean {near[0]}?" if near else ""
        raise InvalidInputError(f"{label}: {getattr(module, '__file__', where)} has no {name}{remedy}") from None


def user_error(error: Exception, doing: str) -> UserCodeError:
    """What to raise from ``error``, which the user's code raised."""
    text = str(error).strip().splitlines()
    return UserCodeError(f"{doing} raised {type(error).__name__}" + (f": {text[0]}" if text else ""))


def parse_arguments(words: Sequence[str]) -> dict[str, Any]:
    """Keyword arguments from ``key=value`` words, whose values are JSON or else text, or from one JSON object.

    Raises:
        InvalidInputError: neither of the two.
    """
    arguments: dict[str, Any] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if word.lstrip().startswith("{"):
            try:
                arguments |= json.loads(word)
            except ValueError as error:
                raise InvalidInputError(f"arguments {word!r}: not a JSON object ({error})") from error
        elif equals and key.isidentifier():
            try:
                arguments[key] = json.loads(value)
            except ValueError:
                arguments[key] = value
        else:
            raise InvalidInputError(f"argument {word!r}: give key=value, or one JSON object")
    return arguments


def content_sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file, or of all names and contents in a folder.

    Raises:
        InvalidInputError: there is no such file or folder.
    """
    if path.is_file():
        return sha256_file(path)
    if not path.is_dir():
        raise InvalidInputError(f"model {path}: no such file or folder; check the path")
    files = sorted(file for file in path.rglob("*") if file.is_file())
    lines = [f"{file.relative_to(path).as_posix()} {sha256_file(file)}\n" for file in files]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _file_module(path: Path, label: str) -> ModuleType:
    """The module of a file that lies anywhere; executed once, and again after a change."""
    if not path.is_file():
        raise InvalidInputError(f"{label}: there is no file {path}")
    name = f"{path.stem}_{hashlib.sha256(f'{path.resolve()} {sha256_file(path)}'.encode()).hexdigest()[:8]}"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module  # dataclasses look their module up
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]


def _check_arguments(factory: Callable[..., Any], given: Mapping[str, Any], label: str) -> None:
    """Raises InvalidInputError unless ``factory`` takes these keyword arguments."""
    try:
        signature = inspect.signature(factory)
    except (TypeError, ValueError):  # some written in C have none
        return
    try:
        signature.bind(**given)
    except TypeError as error:
        accepts = {p.name for p in signature.parameters.values()}
        if "model" in given and "model" not in accepts:
            raise InvalidInputError(f"{label}: takes no model; leave {given['model']} out") from None
        raise InvalidInputError(f"{label}: {error}; its arguments are {signature}") from None
