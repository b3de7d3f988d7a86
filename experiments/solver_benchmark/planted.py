"""RBMs with a known ground state: sums of frustrated loops (Hen et al. 2015; Pei, Manukian, Di Ventra 2020).

In spin form E = -sum J_ij s_i t_j. A loop v-h-v'-h' has three bonds +1 and one bond -1; with all spins up that
bond alone is not satisfied, E = -2, and no state of the loop has less. So the state of all spins up minimises
every loop at once, and their sum: -2 a loop. A random gauge s_i -> g_i s_i hides it.

At a density of .75 loops a spin simulated annealing fails most often (looked at for 60 to 200 units a layer).
"""

import torch
from torch import Generator, Tensor

from memcomp_lightning.problems import Bipartite, Qubo


def frustrated_loops(
    n_visible: int, n_hidden: int, density: float = 0.75, *, generator: Generator
) -> tuple[Qubo, Tensor, float]:
    """Return the problem, the planted state and its energy, exact because all numbers are small integers.

    Args:
        n_visible: Units of the first layer, >= 2.
        n_hidden: Units of the second layer, >= 2.
        density: Loops a spin; few loops leave many ground states, many point to the planted one.
        generator: Random stream.
    """
    n_loops = round(density * (n_visible + n_hidden))
    v, h = (torch.empty(n_loops, n).uniform_(generator=generator).topk(2).indices for n in (n_visible, n_hidden))
    bonds = torch.zeros(n_hidden, n_visible, dtype=torch.float64)
    frustrated = torch.randint(4, (n_loops,), generator=generator)
    for k in range(4):
        bond = torch.where(frustrated == k, -1.0, 1.0).double()
        bonds.index_put_((h[:, k // 2], v[:, k % 2]), bond, accumulate=True)
    gauge = torch.randint(2, (n_visible + n_hidden,), generator=generator) * 2.0 - 1
    bonds *= gauge[n_visible:, None] * gauge[:n_visible]
    return from_spins(bonds), (gauge + 1) / 2, -2.0 * n_loops


def from_spins(bonds: Tensor) -> Qubo:
    """The problem whose energy at x is -sum J_ij s_i t_j at the spins 2 x - 1; bonds J: (n_hidden, n_visible)."""
    n_hidden, n_visible = bonds.shape
    return Qubo(
        graph=Bipartite(n_first=n_visible, n_second=n_hidden),
        coupling=-4 * bonds.float(),
        linear=2 * torch.cat((bonds.sum(0), bonds.sum(1))).float(),
        offset=-bonds.sum(),
    )
