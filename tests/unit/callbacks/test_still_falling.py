"""Whether training on few labels ended too early."""

import logging
from types import SimpleNamespace

import pytest
import torch

from memcomp_lightning.callbacks import StillFalling
from memcomp_lightning.training import Score


def trained(losses, *, n_correct=5, planned=None):
    callback = StillFalling()
    for n, loss in enumerate(losses):
        if n == len(losses) // 2:  # an interruption
            state, callback = callback.state_dict(), StillFalling()
            callback.load_state_dict(state)
        callback.on_train_epoch_start()
        for share in (0.25, 0.75):
            score = Score(torch.tensor([10 * loss * share]), torch.tensor([n_correct / 2]), 5)
            callback.on_train_batch_end(None, None, {"score": score})
        callback.on_train_epoch_end()
    callback.on_train_end(SimpleNamespace(max_epochs=planned or len(losses), is_global_zero=True), None)


FALLS = [2.0 - 0.08 * n for n in range(20)]


@pytest.mark.parametrize(
    ("losses", "settings", "said"),
    [
        (FALLS, {}, "from 0.68 to 0.52 in the last passes"),
        ([*FALLS, *[0.48] * 10], {}, ""),  # settled
        (FALLS, {"n_correct": 10}, ""),  # all rows are right
        (FALLS, {"planned": 40}, ""),  # something else ended it
        ([3.0, 2.0, 1.0], {}, ""),  # too few passes to tell
    ],
)
def test_it_is_said_where_the_loss_still_fell(losses, settings, said, caplog):
    with caplog.at_level(logging.INFO):
        trained(losses, **settings)
    assert bool(caplog.text) == bool(said)
    assert said in caplog.text
    assert not said or "type finetune.iterations=200, say." in caplog.text
