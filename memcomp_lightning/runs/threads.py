"""How many threads a stage computes with."""

import os
from contextlib import AbstractContextManager, nullcontext

from memcomp_lightning.ambient import in_one_thread
from memcomp_lightning.studies.plan import Stage

WORTH_THREADS = 2**22
"""Products of a unit and a weight in an update from which a second thread helps: about a millisecond."""


def threads_for(stage: Stage) -> AbstractContextManager[None]:
    """Compute small updates in one thread, as fast as in several.

    More threads would wait for work by spinning, which makes two runs side by side ten times slower. If
    ``OMP_NUM_THREADS`` is set, nothing is changed.
    """
    n_products = stage.data.n_at_once * max(parameter.numel() for parameter in stage.module.parameters())
    alone = "OMP_NUM_THREADS" not in os.environ and n_products < WORTH_THREADS
    return in_one_thread() if alone else nullcontext()
