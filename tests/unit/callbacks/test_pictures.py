"""Pictures: which passes are looked at."""

from pathlib import Path

import pytest
from foreign import PREFIX, TheirRBM, events_in, fit, tensorboard

from memcomp_lightning.callbacks import ChainPictures, ModelSamples


@pytest.mark.filterwarnings("ignore:.*does not have many workers.*")
@pytest.mark.usefixtures("allow_global_rng")  # torch's DataLoader draws a base seed
@pytest.mark.parametrize(("every", "expected"), [(1, 5), (2, 3), (3, 3), (10, 2)])
def test_first_and_last_pass_have_a_picture(tmp_path: Path, every: int, expected: int) -> None:
    callbacks = [ChainPictures(every=every, n_chains=2), ModelSamples(every=every, n_samples=2, n_sweeps=1)]
    fit(tmp_path, callbacks, tensorboard(tmp_path), TheirRBM(), n_passes=5)
    for tag in ("chains", "samples"):
        assert len(events_in(tmp_path).Images(f"{PREFIX}/{tag}")) == expected
