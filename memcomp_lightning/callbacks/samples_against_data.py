"""Samples of the model against the data: marginals, pairs, and the plane in which the data vary most."""

from matplotlib.figure import Figure

from memcomp_lightning import rng
from memcomp_lightning.callbacks.against_samples import AgainstSamples, Seen
from memcomp_lightning.errors import require_count
from memcomp_lightning.plotting.against_data import plot_against_data


class SamplesAgainstData(AgainstSamples):
    """Draws samples beside data and held-out data: pictures ``marginals``, ``correlations`` and ``plane``.

    Of units of every kind, in the columns and words of the data, if the data module has a ``schema``; see
    :func:`memcomp_lightning.plotting.plot_marginals`, ``plot_correlations`` and ``plot_plane``. One set of chains
    serves all three. Data that are means in between, as grey values are, are drawn, so that they are of the same
    kind as the samples. A model with one visible unit has its marginals alone.

    Args:
        every: Passes between two sets of pictures, >= 1.
        n_images: Training images, and held-out ones, to take, >= 1.
        n_samples: Chains, >= 1.
        n_sweeps: Gibbs sweeps of each chain, >= 1.
        n_panels: Most columns whose marginals are drawn: those that differ most, >= 1.
        seed: Seed of the chains and the draws.
    """

    def __init__(
        self,
        every: int = 20,
        n_images: int = 2000,
        n_samples: int = 1000,
        n_sweeps: int = 100,
        n_panels: int = 12,
        seed: int = 0,
    ) -> None:
        super().__init__(every, n_images, n_samples, n_sweeps, seed)
        require_count("n_panels", n_panels)
        self.n_panels = n_panels

    def figures(self, seen: Seen) -> dict[str, Figure]:
        """The three figures."""
        generator = rng.stream(self.seed, "evaluation", 1)
        data = seen.data.drawn(generator)
        heldout = None if seen.heldout is None else seen.heldout.drawn(generator)
        return plot_against_data(data, seen.samples, heldout, n_panels=self.n_panels)
