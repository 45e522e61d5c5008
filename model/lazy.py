"""Public names of a package that are loaded on first use (PEP 562)."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

_ROOT = Path(__file__).parents[1]


def lazy_names(
    package: str, origins: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """The functions `__getattr__` and `__dir__` of a package.

    Importing the package then loads none of its modules, as children of the real-time process
    and `cdpr --help` need it.

    Args:
        package: Its ``__name__``.
        origins: Public names of each module, separated by spaces. Those modules that are in the
            package can be loaded by name, too.
    """
    module_of = {name: module for module, names in origins.items() for name in names.split()}

    def load(name: str) -> Any:
        if f"{package}.{name}" in origins:
            return _imported(f"{package}.{name}")
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(_imported(module_of[name]), name)
        setattr(sys.modules[package], name, value)  # the next use finds it without this function
        return value

    def listed() -> list[str]:
        return sorted({*vars(sys.modules[package]), *module_of})

    return load, listed


def hidden_package(error: ImportError) -> tuple[str, str] | None:
    """The package of ours whose import failed, and the file or folder of the user that hides it.

    None where the error has another cause.
    """
    package = str(error.name).partition(".")[0]
    found = sys.modules.get(package)
    locations = [getattr(found, "__file__", None), *getattr(found, "__path__", ())]
    theirs = [path for path in locations if path and not Path(path).is_relative_to(_ROOT)]
    is_ours = (_ROOT / package / "__init__.py").is_file()
    return (package, theirs[0]) if is_ours and theirs else None


def _imported(module: str) -> ModuleType:
    """A module of this project."""
    try:
        return import_module(module)
    except ImportError as error:
        if (hidden := hidden_package(error)) is None:
            raise
        package, path = hidden
        raise ImportError(
            f"{path} hides the package `{package}` of cdpr: rename it", name=package, path=path
        ) from error
