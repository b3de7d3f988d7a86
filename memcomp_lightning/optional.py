"""Import a module only when it is asked for, because it needs a package that may not be installed."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

WITHOUT_DIMOD = (
    "Samplers and solvers of dimod need dimod, which is not installed: pip install 'memcomp-lightning[dimod]'."
)


def on_demand(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package that imports some of its modules when they are asked for.

    Args:
        package: Its name.
        modules: Of each name, the module that holds it. The module says what to install where its import fails.
    """

    def find(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{modules[name]}"), name)

    return find
