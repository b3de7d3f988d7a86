"""A quantum annealer of D-Wave for Boltzmann machines, programmed as Adachi & Henderson did (arXiv 1510.06356)."""

import logging
from collections.abc import Hashable, Iterable, Mapping
from typing import Any, Literal, NamedTuple

from memcomp_lightning.errors import SettingError, require, require_choice, require_count

try:
    import dimod
    import networkx as nx
    from dimod import BinaryQuadraticModel, SampleSet, Vartype
    from dwave import graphs
    from dwave.embedding import embed_bqm, unembed_sampleset
    from dwave.embedding.chain_breaks import discard, majority_vote
    from dwave.embedding.chain_strength import uniform_torque_compensation
    from dwave.preprocessing.composites import SpinReversalTransformComposite
    from dwave.system import DWaveSampler
    from minorminer import find_embedding
    from minorminer.busclique import busgraph_cache
except ModuleNotFoundError:
    raise ModuleNotFoundError(
        "A quantum annealer needs D-Wave's Ocean SDK, which is not installed: "
        "pip install 'memcomp-lightning[dwave]'."
    ) from None

log = logging.getLogger(__name__)

Unit = Hashable
Embedding = dict[Unit, tuple[int, ...]]


class Layout(NamedTuple):
    """Where a model lies on an annealer: the chain of each unit, and couplings for which there is no coupler."""

    chains: Embedding
    uncoupled: list[tuple[Unit, Unit]]


class QpuSampler(dimod.ComposedSampler):  # type: ignore[name-defined, misc]
    """Sample Boltzmann machines on a quantum annealer; each unit becomes a chain of qubits.

    An RBM is laid out as a biclique, visible chains across hidden chains; for other machines an embedding is
    searched for. Either is done once for each graph. Problems keep the scale they come with (``auto_scale`` is
    off), as an effective temperature holds for one scale only; a problem beyond the range of the qubits is shrunk,
    with a warning.

    Args:
        qpu: The annealer, a structured sampler; None connects to D-Wave's service, as its configuration says.
        n_gauges: Spin-reversal gauges among which the reads are divided, >= 1.
        chain_strength: Ferromagnetic coupling within a chain, in units of the largest coupling, > 0; None takes
            D-Wave's rule, uniform torque compensation.
        chain_breaks: What becomes of a read whose chains disagree: the "majority" of the chain, or "discard"; if
            none is left, the majority.
        faulty: "avoid" lays out around missing qubits and couplers; "prune" takes the regular layout of the whole
            graph, as Adachi & Henderson did: missing qubits leave their chains, and units whose chains are left
            without a coupler between them are not coupled.
        seed: Of the search for an embedding.

    Raises:
        SettingError: A setting is out of range; the service cannot be reached; on sampling, no embedding is found.
    """

    def __init__(
        self,
        qpu: Any = None,
        *,
        n_gauges: int = 1,
        chain_strength: float | None = None,
        chain_breaks: Literal["majority", "discard"] = "majority",
        faulty: Literal["avoid", "prune"] = "avoid",
        seed: int = 0,
    ) -> None:
        require_count("n_gauges", n_gauges)
        if chain_strength is not None:
            require(chain_strength > 0, "chain_strength", chain_strength, "a number > 0, or null")
        require_choice("chain_breaks", chain_breaks, ("majority", "discard"))
        require_choice("faulty", faulty, ("avoid", "prune"))
        self.qpu = _connected() if qpu is None else qpu
        structured = hasattr(self.qpu, "structure")
        require(structured, "qpu", type(self.qpu).__name__, "a structured dimod sampler, such as DWaveSampler")
        self.n_gauges, self.chain_strength, self.chain_breaks = n_gauges, chain_strength, chain_breaks
        self.faulty, self.seed = faulty, seed
        self._known: dict[tuple[frozenset[Unit], frozenset[frozenset[Unit]]], Layout] = {}
        self._warned = False

    @property
    def children(self) -> list[Any]:
        """The annealer."""
        return [self.qpu]

    @property
    def parameters(self) -> Mapping[str, object]:
        """Those of the annealer, and the seed of the gauges."""
        return {**self.qpu.parameters, "seed": []}

    @property
    def properties(self) -> Mapping[str, object]:
        """Those of the annealer."""
        return {"child_properties": self.qpu.properties}

    def sample(
        self, bqm: BinaryQuadraticModel, *, num_reads: int = 100, seed: int | None = None, **parameters: object
    ) -> SampleSet:
        """Return ``num_reads`` reads; ``chain_break_fraction`` is a field of each.

        Args:
            bqm: A model of either vartype.
            num_reads: A multiple of ``n_gauges``.
            seed: Of the gauges.
            parameters: Of the annealer: ``annealing_time``, ``label``, ...
        """
        each, rest = divmod(num_reads, self.n_gauges)
        require(rest == 0 < each, "num_reads", num_reads, f"a multiple of n_gauges = {self.n_gauges}")
        (embedding, uncoupled), spin = self.layout(bqm), bqm.change_vartype(Vartype.SPIN, inplace=False)
        kept = BinaryQuadraticModel(spin) if uncoupled else spin
        kept.remove_interactions_from(uncoupled)
        target: Any = embed_bqm(kept, embedding, self.qpu.adjacency, chain_strength=self._strength)
        self._fit(target)
        if "auto_scale" in self.qpu.parameters:
            parameters.setdefault("auto_scale", False)
        reads = SpinReversalTransformComposite(self.qpu, seed=seed).sample(
            target, num_spin_reversal_transforms=self.n_gauges, num_reads=each, answer_mode="raw", **parameters
        )
        rules = [discard, majority_vote] if self.chain_breaks == "discard" else [majority_vote]
        for rule in rules:
            found = unembed_sampleset(reads, embedding, spin, chain_break_method=rule, chain_break_fraction=True)
            if len(found):
                break
        answer: SampleSet = found.change_vartype(bqm.vartype, inplace=False)
        return answer

    def layout(self, bqm: BinaryQuadraticModel) -> Layout:
        """The place of a model, found once for a graph; raise a SettingError if it has none on this annealer."""
        graph = frozenset(bqm.variables), frozenset(frozenset(pair) for pair in bqm.quadratic)
        if graph not in self._known:
            working = self.qpu.to_networkx_graph()
            whole = working if self.faulty == "avoid" else _without_faults(self.qpu)
            found = _layout(bqm, whole, self.seed)
            chains = {unit: _largest_piece(chain, working) for unit, chain in found.items()}
            lost = [unit for unit in bqm.variables if not chains.get(unit)]
            require(
                not lost,
                f"Boltzmann machine of {bqm.num_variables} units and {bqm.num_interactions} couplings",
                f"no place for units {lost[:5]}",
                f"one that fits on {type(self.qpu).__name__} with its {len(working)} qubits",
                "Take fewer units, a larger annealer, or faulty='prune'.",
            )
            self._known[graph] = Layout(chains, self._uncoupled(bqm, chains))
        return self._known[graph]

    def _strength(self, bqm: BinaryQuadraticModel, embedding: Embedding) -> float:
        if self.chain_strength is None:
            return float(uniform_torque_compensation(bqm, embedding))
        return self.chain_strength * max((abs(value) for value in bqm.quadratic.values()), default=1.0)

    def _uncoupled(self, bqm: BinaryQuadraticModel, chains: Embedding) -> list[tuple[Unit, Unit]]:
        if self.faulty == "avoid":
            return []
        near = self.qpu.adjacency
        return [(u, v) for u, v in bqm.quadratic if not any(near[qubit] & set(chains[v]) for qubit in chains[u])]

    def _fit(self, target: Any) -> None:
        """Shrink a problem that is beyond the range of the qubits.

        The smaller end of each range counts: gauges turn signs, and D-Wave's extended range is wider for one only.
        """
        ranges = {"h_range": target.linear.values(), "j_range": target.quadratic.values()}
        excess = max(
            max(abs(value) for value in values) / min(abs(end) for end in self.qpu.properties[name])
            for name, values in ranges.items()
            if values
        )
        if excess > 1:
            if not self._warned:
                log.warning(
                    "At the given temperature the model is %.3g times beyond the annealer's range and is shrunk. "
                    "Samples are hotter than beta says; weight decay keeps a model smaller.",
                    excess,
                )
                self._warned = True
            target.scale(1 / excess)


def _connected() -> Any:
    try:
        return DWaveSampler()
    except Exception as error:  # of several libraries, down to sockets
        raise SettingError(
            f"D-Wave's service cannot be used: {error}. Set DWAVE_API_TOKEN, or run `dwave config create`; "
            "sampler=annealer needs neither."
        ) from None


def _without_faults(qpu: Any) -> nx.Graph:
    """The graph of the annealer's family and size with every qubit and coupler."""
    topology = qpu.properties["topology"]
    whole: nx.Graph = getattr(graphs, f"{topology['type']}_graph")(*topology["shape"])
    return whole


def _layout(bqm: BinaryQuadraticModel, graph: nx.Graph, seed: int) -> Embedding:
    """Chains on a graph; empty if there is no embedding."""
    units = nx.Graph(bqm.quadratic)
    units.add_nodes_from(bqm.variables)
    if len(units) > 1 and nx.is_connected(units) and nx.is_bipartite(units):
        sides = [sorted(side) for side in nx.bipartite.sets(units)]
        if units.number_of_edges() == len(sides[0]) * len(sides[1]):
            chains = busgraph_cache(graph).find_biclique_embedding(*sides)
            return {unit: tuple(chain) for unit, chain in chains.items()}
    found = find_embedding(units.edges, graph.edges, random_seed=seed)
    spare = iter(set(graph) - {qubit for chain in found.values() for qubit in chain})
    alone = {unit: (next(spare),) for unit in nx.isolates(units)} if found or not units.edges else {}
    return {unit: tuple(chain) for unit, chain in found.items()} | alone


def _largest_piece(chain: Iterable[int], working: nx.Graph) -> tuple[int, ...]:
    pieces = [tuple(sorted(piece)) for piece in nx.connected_components(working.subgraph(chain))]
    return max(pieces, key=len, default=())
