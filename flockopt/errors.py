"""Exceptions of flockopt.

Only broken input and broken tools raise. "Infeasible", "out of time" and "uncertified" are answers and
come back as statuses.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__all__ = [
    "FieldError", "FlockError", "MissingExtra", "PlanError", "SceneError", "SettingsError", "SolverFailed", "is_interrupt",
    "require",
]  # fmt: skip


class FlockError(Exception):
    """Base of everything flockopt raises on purpose."""


class FieldError(FlockError, ValueError):
    """A field has a value it may not have.

    Args:
        field: Path of the field, such as ``drones[3].capacity``; empty for the document itself.
        value: Words for the value seen, such as ``is -1`` or ``is missing``.
        rule: What values are allowed.
        mend: What to change.
    """

    def __init__(self, field: str, value: str, rule: str, mend: str = "") -> None:
        self.field, self.value, self.rule, self.mend = field, value, rule, mend
        head = f"{field} {value}" if field else value
        super().__init__("; ".join(part for part in (head, rule, mend) if part))

    def within(self, prefix: str) -> FieldError:
        """The same error seen from the record that holds this one: ``capacity`` → ``drones[3].capacity``."""
        if not self.field:
            path = prefix
        elif self.field.startswith("["):
            path = prefix + self.field
        else:
            path = f"{prefix}.{self.field}"
        return type(self)(path, self.value, self.rule, self.mend)


class SceneError(FieldError):
    """A scene is malformed."""


class PlanError(FieldError):
    """A plan is malformed, or belongs to another scene."""


class SettingsError(FieldError):
    """A setting or an argument has a value it may not have."""


class MissingExtra(FlockError, ImportError):
    """An optional dependency is not installed; the message names the extra that brings it."""

    def __init__(self, package: str, extra: str) -> None:
        self.package, self.extra = package, extra
        mend = f"pip install 'flockopt[{extra}]', where it has a wheel (docs/installing.md)"
        super().__init__(f"{package} is not installed; it comes with the extra '{extra}'; {mend}")


def require(module: str, extra: str, package: str = "") -> Any:
    """A module of an optional dependency, imported when it is first asked for.

    Args:
        module: Its name, such as ``matplotlib.figure``.
        extra: The extra of flockopt that brings it.
        package: What pip calls it, where that is not the module's first name.

    Raises:
        MissingExtra: If it is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        raise MissingExtra(package or module.partition(".")[0], extra) from None


class SolverFailed(FlockError, RuntimeError):
    """A backend crashed or returned nonsense; the message carries its name and its own words."""

    def __init__(self, solver: str, message: str) -> None:
        self.solver = solver
        super().__init__(f"{solver} failed: {message}")


def is_interrupt(fault: BaseException | None) -> bool:
    """Whether it is an interrupt; one that comes while compiled code makes its result is the cause of another error."""
    while fault is not None:
        if isinstance(fault, KeyboardInterrupt):
            return True
        fault = fault.__cause__ or fault.__context__
    return False
