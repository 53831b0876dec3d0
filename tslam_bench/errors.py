"""Errors a user can cause. Each message is one line: what is wrong, where, and the remedy."""


class BenchmarkError(Exception):
    """Base class; command lines print its message on one line and exit with status 2."""


class InvalidInputError(BenchmarkError, ValueError):
    """An argument, a file or a submission is not what it has to be."""


class AssetError(BenchmarkError, RuntimeError):
    """Asset data is missing, corrupt, or cannot be fetched or written."""


class MissingPackageError(BenchmarkError, ImportError):
    """A package of an extra that is not installed is needed."""


class UserCodeError(BenchmarkError, RuntimeError):
    """A policy or reconstructor of the user's own raised something, which is the cause of this error."""
