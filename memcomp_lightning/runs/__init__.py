"""What a run is: its folder, its stages one after the other, and the tables of what it found."""

from memcomp_lightning.optional import on_demand

__all__ = ["RunFolder", "run"]

# Tables are printed by commands that start without torch.
__getattr__ = on_demand(__name__, {"RunFolder": "folder", "run": "pipeline"})
