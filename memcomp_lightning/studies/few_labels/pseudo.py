"""Self-training: a network learns on from its own surest answers for rows without a label (Lee 2013)."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from memcomp_lightning import rng
from memcomp_lightning.studies.few_labels.data import Sets
from memcomp_lightning.studies.few_labels.learner import Context, Point, point_of
from memcomp_lightning.studies.few_labels.networks import Network, trained
from memcomp_lightning.studies.search import Setting
from memcomp_lightning.training import DivergedError


@dataclass(frozen=True, kw_only=True)
class PseudoLabels:
    """Goes on from a network that was tuned and trained with the labels alone.

    A setting says which share of the rows without a label it takes, the surest ones; 0 leaves the network as it
    is. Labelled rows are repeated, so that they are about half of each pass.

    Attributes:
        base: The network.
        unlabelled: Rows without a label that it looks at, at most.
        passes: After which is measured.
    """

    base: Network
    unlabelled: int
    passes: Sequence[int]

    def learn(self, context: Context, sets: Sets, setting: Setting, passes: Sequence[int] | None) -> list[Point]:
        """See :class:`Learner`."""
        assert context.base is not None
        of_base = dict(context.base)
        found: list[Point] = []
        with contextlib.suppress(DivergedError):
            *_, (_, network) = self.base.fit(context, sets, of_base, (int(of_base["passes"]),))
            others = _without_label(sets, self.unlabelled)
            n_taken = round(setting["share"] * len(others))
            if not n_taken:
                return [point_of(0, network, sets)]
            points = tuple(self.passes) if passes is None else tuple(passes)
            taken = _with_pseudo_labels(network, sets, others, n_taken)
            size = context.lengths.batch_size(taken[0].shape[-1])
            for done, now in trained(network, sets, of_base, points, size, others=taken):
                found.append(point_of(done, now, sets))
        return found


def _without_label(sets: Sets, most: int) -> Tensor:
    """Places of some rows that have a label in none of the sets."""
    order = torch.randperm(len(sets.rows), generator=rng.stream(sets.seed, "unlabelled"), device="cpu")
    return order[~torch.isin(order, sets.at.unique())][:most]


@torch.no_grad()
def _with_pseudo_labels(network: nn.Module, sets: Sets, others: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Places and classes of the labelled rows, repeated, and of the ``n`` others of which a network is surest."""
    network.eval()
    parts = [network(sets.rows[some].expand(sets.n_sets, -1, -1)) for some in others.split(2000)]
    sure, answer = torch.cat(parts, dim=-2).softmax(-1).max(-1)
    first = sure.topk(n, dim=-1).indices
    repeats = max(1, round(n / sets.at.shape[-1]))
    at = torch.cat((sets.at.repeat(1, repeats), others[first]), dim=-1)
    return at, torch.cat((sets.label.repeat(1, repeats), answer.gather(-1, first)), dim=-1)
