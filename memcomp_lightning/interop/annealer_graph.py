"""Connectivity of quantum annealers, for Boltzmann machines that fit on one."""

from typing import Literal

import torch
from jaxtyping import Int
from torch import Tensor

from memcomp_lightning.errors import require, require_choice, require_count
from memcomp_lightning.models.connectivity import from_graph, from_pairs

Kind = Literal["chimera", "pegasus", "zephyr"]


def annealer_graph(kind: Kind, size: int, n_visible: int) -> Int[Tensor, "n_pairs 2"]:
    """Coupled pairs of a Chimera, Pegasus or Zephyr graph, numbered with the visible units first.

    Visible units lie evenly over the graph, so that each has hidden units around it. The number of units follows
    from kind and size: 8 size^2 of Chimera, about 24 size (size - 1) of Pegasus, 16 size (2 size + 1) of Zephyr.

    Args:
        kind: Family of the graph: Chimera (D-Wave 2000Q), Pegasus (Advantage), Zephyr (Advantage2).
        size: The family's parameter m, >= 1; >= 2 of Pegasus.
        n_visible: Units that are visible, >= 1.

    Raises:
        SettingError: The graph has no more units than are visible.
        ModuleNotFoundError: dwave-graphs is not installed; says how to get it.
    """
    require_choice("kind", kind, ("chimera", "pegasus", "zephyr"))
    require_count("size", size, minimum=2 if kind == "pegasus" else 1)
    require_count("n_visible", n_visible)
    try:
        from dwave import graphs
    except ImportError:
        raise ModuleNotFoundError(
            "Graphs of annealers come from dwave-graphs, which is not installed: "
            "pip install 'memcomp-lightning[dimod]'."
        ) from None
    graph = getattr(graphs, f"{kind}_graph")(size)
    pairs, n_units = from_graph(graph), graph.number_of_nodes()
    allowed = f"less than the {n_units} units of {kind} graph {size}"
    require(n_visible < n_units, "n_visible", n_visible, allowed, "Raise size, or take data with fewer inputs.")
    visible = torch.arange(n_visible) * n_units // n_visible
    hidden = torch.arange(n_units)[~torch.isin(torch.arange(n_units), visible)]
    number = torch.cat((visible, hidden)).argsort()
    return from_pairs(n_units, number[pairs])
