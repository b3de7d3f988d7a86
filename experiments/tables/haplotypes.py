"""Genotypes whose distribution is known: mosaics of founders, in several populations (after Li & Stephens 2003).

A chromosome copies one founder of its block from site to site; with a small probability it takes up another one,
drawn with the weights that its population gives the founders. Blocks are independent given the population. A
genotype counts the ones of two chromosomes, each misread with a small probability. Sums over all mosaics are those
of a hidden Markov chain, so that likelihoods and the probabilities of missing cells are exact.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Genotypes = NDArray[np.int64]

N_VALUES = 3
"""A genotype is 0, 1 or 2."""


class Exact(NamedTuple):
    """What the model that made a table says of its rows.

    Attributes:
        log_likelihood: Of what is observed of each row, ``(n,)``.
        probability: Of each value of each missing cell given those that are observed, ``(n, n_sites, 3)``; what it
            says of an observed cell has no meaning.
    """

    log_likelihood: Matrix
    probability: Matrix


class Panel(NamedTuple):
    """Founders and how often populations have them.

    Attributes:
        founders: Alleles, ``(n_blocks, n_founders, n_sites_of_block)`` of 0 and 1.
        weight: Of each founder, ``(n_populations, n_blocks, n_founders)``.
        switch: Probability that a chromosome takes up another founder between two sites.
        error: Probability that an allele is misread.
    """

    founders: Genotypes
    weight: Matrix
    switch: float = 0.05
    error: float = 0.01

    @classmethod
    def draw(
        cls,
        generator: np.random.Generator,
        *,
        n_blocks: int = 10,
        n_sites_of_block: int = 10,
        n_founders: int = 6,
        n_populations: int = 4,
    ) -> "Panel":
        """Founders that differ at each site, and weights of each population of its own."""
        founders = np.zeros((n_blocks, n_founders, n_sites_of_block), dtype=np.int64)
        while (same := founders.min(1) == founders.max(1)).any():
            drawn = generator.integers(0, 2, founders.shape)
            founders = np.where(same[:, None], drawn, founders)
        return cls(founders, generator.dirichlet(np.ones(n_founders), (n_populations, n_blocks)))

    def of(self, populations: slice) -> "Panel":
        """Some of the populations."""
        return self._replace(weight=self.weight[populations])

    def sample(self, n: int, generator: np.random.Generator) -> Genotypes:
        """Individuals of all populations alike, ``(n, n_sites)``."""
        n_blocks, _, n_sites = self.founders.shape
        population, found = generator.integers(0, len(self.weight), n), np.zeros((n, n_blocks, n_sites), np.int64)
        below = self.weight.cumsum(-1)[population]
        for _ in range(2):
            now = np.zeros(n, dtype=np.int64)
            for block in range(n_blocks):
                for site in range(n_sites):
                    other = (below[:, block] < generator.random((n, 1))).sum(-1).clip(max=below.shape[-1] - 1)
                    new = (generator.random(n) < self.switch) if site else np.ones(n, dtype=bool)
                    now = np.where(new, other, now)
                    misread = generator.random(n) < self.error
                    found[:, block, site] += self.founders[block, now, site] ^ misread
        return found.reshape(n, -1)

    def exact(self, rows: Genotypes, observed: NDArray[np.bool_]) -> Exact:
        """Likelihoods of rows and probabilities of missing cells, populations being equally probable before."""
        n_blocks, n_founders, n_sites = self.founders.shape
        n, shape = len(rows), (len(rows), n_blocks, n_sites)
        rows, observed = rows.reshape(shape), observed.reshape(shape)
        log_likelihood, parts = np.zeros((len(self.weight), n)), []
        for population, weights in enumerate(self.weight):
            of_cells = np.empty((*shape, N_VALUES))
            for block, weight in enumerate(weights):
                stay = (1 - self.switch) * np.eye(n_founders)
                step = stay + self.switch * weight
                # A state is a founder of either chromosome; of both the steps are independent.
                step, first = np.kron(step, step), np.kron(weight, weight)
                of_value = self._of_values(self.founders[block])
                emitted = np.where(
                    observed[:, block, :, None],
                    of_value[np.arange(n_sites), :, rows[:, block]],
                    1.0,
                )
                forward, scale = np.empty((n_sites, n, len(first))), np.empty((n_sites, n, 1))
                for site in range(n_sites):
                    reached = forward[site - 1] @ step if site else first
                    forward[site] = reached * emitted[:, site]
                    scale[site] = forward[site].sum(-1, keepdims=True)
                    forward[site] /= scale[site]
                log_likelihood[population] += np.log(scale).sum((0, 2))
                backward = np.ones((n, len(first)))
                for site in reversed(range(n_sites)):
                    before = forward[site - 1] @ step if site else np.broadcast_to(first, backward.shape)
                    joint = before * backward
                    found = joint @ of_value[site]
                    of_cells[:, block, site] = found / found.sum(-1, keepdims=True)
                    backward = (emitted[:, site] * backward) @ step.T
                    backward /= backward.sum(-1, keepdims=True)
            parts.append(of_cells)
        log_likelihood -= np.log(len(self.weight))
        total = np.logaddexp.reduce(log_likelihood, axis=0)
        share = np.exp(log_likelihood - total)
        probability = np.einsum("pn,pnbsv->nbsv", share, np.stack(parts))
        return Exact(total, probability.reshape(n, -1, N_VALUES))

    def _of_values(self, founders: Genotypes) -> Matrix:
        """Probability of each genotype by site and pair of founders, ``(n_sites, n_founders^2, 3)``."""
        one = np.where(founders == 1, 1 - self.error, self.error).T
        first, second = np.repeat(one, len(founders), axis=1), np.tile(one, len(founders))
        both = [(1 - first) * (1 - second), first * (1 - second) + second * (1 - first), first * second]
        return np.stack(both, axis=-1)
