"""Train restricted Boltzmann machines and deep belief networks, with a choice of samplers for the gradient."""

__version__ = "0.2.0"
__all__ = ["solve"]

TYPE_CHECKING = False  # typing takes time before Ctrl-C is answered
if TYPE_CHECKING:
    from memcomp_lightning.solving import solve


def __getattr__(name: str) -> object:
    if name != "solve":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module("memcomp_lightning.solving"), name)
