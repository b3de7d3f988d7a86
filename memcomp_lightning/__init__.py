"""Train restricted Boltzmann machines and deep belief networks, with a choice of samplers for the gradient."""

__version__ = "0.3.0"
__all__ = ["load", "solve"]

TYPE_CHECKING = False  # typing takes time before Ctrl-C is answered
if TYPE_CHECKING:
    from memcomp_lightning.solving import solve
    from memcomp_lightning.trained import load


_HOMES = {"load": "memcomp_lightning.trained", "solve": "memcomp_lightning.solving"}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
