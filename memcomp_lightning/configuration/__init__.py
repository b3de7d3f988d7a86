"""From settings by name to the objects of a run or of a study: what any front end needs, and Hydra composes.

>>> from hydra import compose
>>> from memcomp_lightning.configuration import build
>>> with composing():
...     plan = build(compose("config", ["sampler=cd", "model.hidden_sizes=[16]"]))
>>> [stage.module.stage for stage in plan.stages]
['pretrain', 'finetune']
"""

from typing import TYPE_CHECKING

from memcomp_lightning.configuration.composition import composed_for, composing
from memcomp_lightning.configuration.values import check_values, filled
from memcomp_lightning.optional import on_demand

if TYPE_CHECKING:
    from memcomp_lightning.configuration.plans import build
    from memcomp_lightning.configuration.trainers import trainer_of

__all__ = ["build", "check_values", "composed_for", "composing", "filled", "trainer_of"]

# A problem is solved without Lightning and torch.
__getattr__ = on_demand(__name__, {"build": "plans", "trainer_of": "trainers"})
