"""Random models of units of all kinds, through every likelihood and sampler, against sums over all their states.

    python tests/campaigns/random_models.py --out FOLDER --count 10000

What is exact is compared with sums and integrals made from the parameters alone (``testing.brute_force``), to nine
digits. Moments of chains, of thousands of them after enough sweeps, must be those of the list of states within
MOST_ERRORS standard errors, which a right sampler exceeds less than once in a million models.
"""

import copy
import sys
import zlib
from collections.abc import Callable, Iterator

import ledger
import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.likelihood import (
    Ais,
    ReverseAis,
    base_of,
    exact_samples,
    log_likelihood,
    log_likelihood_bound,
    log_partition_function,
    log_pseudo_likelihood,
)
from memcomp_lightning.models import DBM, RBM, BoltzmannMachine, Normal
from memcomp_lightning.models.bit_form import at_real_means
from memcomp_lightning.models.connectivity import full
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, ReLU, Spin, Units
from memcomp_lightning.samplers import (
    CD,
    PCD,
    BlockAnnealing,
    Exact,
    GroundState,
    ModeAssisted,
    ModeSchedule,
    ParallelTempering,
    positive_phase,
)
from memcomp_lightning.solvers import BruteForce, GibbsAnnealing
from memcomp_lightning.testing import brute_force, enumerated, most_errors_off

Model = RBM | BoltzmannMachine

N_CHAINS, N_SWEEPS, LONGER = 3000, 24, 32
MOST_ERRORS = 8.0
TOLERANCE = 1e-9


# ------------------------------------------------------------------------------------------------------- models


def visible_layer(random: torch.Generator) -> Units:
    return [_bits, _spins, _categories, _real, _mixed][_whole(random, 0, 4)](random)


def hidden_layer(random: torch.Generator, *, real: bool) -> Units:
    kinds: list[Callable[[torch.Generator], Units]] = [_bits, _spins, _categories, lambda r: ReLU(_whole(r, 1, 2))]
    return kinds[_whole(random, 0, 2 if real else 3)](random)


def _bits(random: torch.Generator) -> Units:
    return Bernoulli(_whole(random, 1, 4))


def _spins(random: torch.Generator) -> Units:
    return Spin(_whole(random, 1, 4))


def _categories(random: torch.Generator) -> Units:
    return Categorical([_whole(random, 1, 4) for _ in range(_whole(random, 1, 2))])


def _real(random: torch.Generator) -> Units:
    n = _whole(random, 1, 3)
    variance = 0.3 + 2 * rng.uniform((n,), generator=random)
    return Gaussian(n, variance=variance, learned=_whole(random, 0, 1) == 1)


def _mixed(random: torch.Generator) -> Units:
    kinds = [Bernoulli(1), Spin(1), Categorical([_whole(random, 2, 3)]), Gaussian(1, variance=0.7)]
    order = torch.randperm(4, generator=random).tolist()
    return Mixed(*(kinds[at] for at in order[: _whole(random, 2, 4)]))


def _whole(random: torch.Generator, least: int, most: int) -> int:
    return int(torch.randint(least, most + 1, (), generator=random))


def model_of(random: torch.Generator) -> tuple[str, Model]:
    """A model with couplings that chains mix over, its precisions and biases drawn."""
    visible, kind = visible_layer(random), ("RBM", "machine", "DBM")[_whole(random, 0, 2)]
    scale = {
        "weight_init": Normal(std=0.15 + 0.45 * float(rng.uniform((), generator=random))),
        "generator": random,
    }
    model: Model
    if kind == "DBM":
        model = DBM(None, [_whole(random, 1, 3), _whole(random, 1, 2)], visible=visible, **scale)
    elif kind == "machine":
        hidden = [Bernoulli, Spin][_whole(random, 0, 1)](_whole(random, 1, 3))
        pairs = _pairs(visible, hidden, random)
        model = BoltzmannMachine(visible=visible, hidden=hidden, connectivity=pairs, **scale)
    else:
        model = RBM(visible=visible, hidden=hidden_layer(random, real=visible.real), **scale)
    with torch.no_grad():
        model.b.normal_(0.2, 0.5, generator=random)
        model.c.normal_(-0.2, 0.5, generator=random)
        for name, tensor in model.state_dict().items():
            if name.endswith(".precision"):
                tensor.mul_(torch.empty_like(tensor).uniform_(0.7, 1.4, generator=random))
    return kind, model


def _pairs(visible: Units, hidden: Units, random: torch.Generator) -> Tensor:
    """Most pairs of sites, no two real ones; each visible site with the first hidden one."""
    pairs = full(visible.n_sites + hidden.n_sites)
    real = [at for at, site in enumerate(brute_force.sites_of(visible)) if site.precision is not None]
    both_real = torch.isin(pairs, torch.tensor(real, dtype=torch.long)).all(-1)
    kept = (rng.uniform((len(pairs),), generator=random) < 0.7) | (pairs[:, 1] == visible.n_sites)
    return pairs[kept & ~both_real]


def rows_of(model: Model, n: int, random: torch.Generator) -> Tensor:
    field = rng.uniform((n, model.n_visible), generator=random, like=model.b) - 0.5
    return model.visible.sample(field, generator=random)


# ------------------------------------------------------------------------------------------------- what is exact


def check_exact(model: Model, random: torch.Generator) -> Iterator[str]:
    """Log Z, likelihoods of rows whole and with gaps, pseudo-likelihoods, and the gradient."""
    model = copy.deepcopy(model).double()
    v = rows_of(model, 3, random)
    log_z, true = log_partition_function(model), brute_force.log_sum(model).detach()
    yield from _near("log Z", log_z, true)
    of_rows = brute_force.log_likelihood(model, v).detach()
    yield from _near("log p", log_likelihood(model, v, log_z), of_rows)
    coupled = _coupled_visible(model)
    if not (model.hidden.real or coupled):
        known = model.visible.over_sites(rng.uniform((3, model.visible.n_sites), generator=random) < 0.6)
        known[0], seen = True, known.any(-1)
        seen[0] = True
        gaps = log_likelihood(model, torch.where(known, v, torch.nan)[seen], log_z, observed=known[seen])
        yield from _near("log p with gaps", gaps, brute_force.log_likelihood(model, v[seen], known[seen]).detach())
    if not model.hidden.real:
        bound = log_likelihood_bound(model, v, log_z, tolerance=1e-10, max_iterations=1000)
        if bool((bound > of_rows + TOLERANCE).any()):
            yield f"a bound of log p, {bound.tolist()}, above {of_rows.tolist()}"
    yield from _pseudo(model, v)
    if not model.hidden.real:
        yield from _gradient(model, v)


def _pseudo(model: Model, v: Tensor) -> Iterator[str]:
    known = torch.arange(model.n_units) < model.n_visible
    rows = torch.cat((v, v.new_zeros(len(v), model.n_hidden)), dim=-1)
    found = log_pseudo_likelihood(model, v)
    for number, site in enumerate(brute_force.sites_of(model.visible)):
        others = known.clone()
        others[site.entries] = False
        true = brute_force.log_sum(model, rows[0], known) - brute_force.log_sum(model, rows[0], others)
        yield from _near(f"pseudo-likelihood of site {number}", found[0, number], true.detach())


def _gradient(model: Model, v: Tensor) -> Iterator[str]:
    """Of mean E(data) less mean E(negative phase), by the exact sampler, against the enumerated log p."""
    stream = rng.stream(0, "negative_phase")
    positive = positive_phase(model, v)
    sampler = Exact()
    negative = sampler.sample(model, sampler.init(model, 1, generator=stream), positive, generator=stream)
    x = negative.configurations
    weight = torch.ones_like(x.v[:, 0]) if x.weight is None else x.weight
    mean = (weight * model.energy(x.v, x.h)).sum() / weight.sum()
    parameters = list(model.parameters())
    found = torch.autograd.grad(mean, parameters, allow_unused=True)
    true = torch.autograd.grad(-brute_force.log_sum(model), parameters, allow_unused=True)
    for (name, _), own, right in zip(model.named_parameters(), found, true, strict=True):
        if own is not None and right is not None:
            yield from _near(f"gradient of {name}", own, right)


def _coupled_visible(model: Model) -> bool:
    pairs = model.quadratic_form().pairs
    return pairs is not None and bool((pairs < model.n_visible).all(-1).any())


def _near(what: str, found: Tensor, true: Tensor) -> Iterator[str]:
    close = found.shape == true.shape and torch.allclose(found, true, rtol=TOLERANCE, atol=TOLERANCE)
    if not close:
        yield f"{what}: {found.tolist()}, and {true.tolist()} by all states"


# ------------------------------------------------------------------------------------------------ what is drawn


def check_drawn(model: Model, random: torch.Generator) -> Iterator[str]:
    """Moments of chains, estimates of log Z from both sides, and ground states."""
    seed = _whole(random, 0, 2**31 - 1)
    if not model.hidden.real:
        exact = enumerated(copy.deepcopy(model).double())
        for name, draw in SAMPLERS.items():
            off = most_errors_off(draw(model, seed, N_SWEEPS), exact)
            if not off < MOST_ERRORS:  # some models mix slowly
                off = most_errors_off(draw(model, seed, LONGER * N_SWEEPS), exact)
            if not off < MOST_ERRORS:
                yield f"{name}: a moment {off:.1f} standard errors off"
        yield from _ground_states(model, seed)
    yield from _annealed(copy.deepcopy(model).double(), seed)


def _by_cd(model: Model, seed: int, sweeps: int) -> Tensor:
    stream = rng.stream(seed, "negative_phase")
    v = model.visible.sample(torch.zeros(N_CHAINS, model.n_visible), generator=stream)
    sampler = CD(k=sweeps)
    found = sampler.sample(
        model, sampler.init(model, 1, generator=stream), positive_phase(model, v), generator=stream
    )
    return _drawn(model, found.configurations, seed)


def _by(sampler: object) -> Callable[[Model, int, int], Tensor]:
    def draw(model: Model, seed: int, sweeps: int) -> Tensor:
        stream = rng.stream(seed, "negative_phase")
        state = sampler.init(model, 1, generator=stream)  # type: ignore[attr-defined]
        positive = positive_phase(model, rows_of(model, 1, stream))
        for _ in range(sweeps // 2):
            found = sampler.sample(model, state, positive, generator=stream)  # type: ignore[attr-defined]
            state = found.state
        return _drawn(model, found.configurations, seed)

    return draw


def _drawn(model: Model, configurations: object, seed: int) -> Tensor:
    """All units of configurations, with those of the last class drawn that stand as means."""
    x, last = torch.cat(configurations[:2], dim=-1), model.blocks()[-1]  # type: ignore[index]
    if last.kind.linear:
        x[..., last.units] = last.kind.sample_of_mean(x[..., last.units], generator=rng.stream(seed, "means"))
    return x


NEVER = ModeSchedule(n_updates=1000, p_max=1e-9, delay=-6.0)
SAMPLERS: dict[str, Callable[[Model, int, int], Tensor]] = {
    "CD": _by_cd,
    "PCD": _by(PCD(k=2, n_chains=N_CHAINS)),
    "parallel tempering": _by(ParallelTempering(k=2, n_chains=N_CHAINS, n_temperatures=3, adaptation=0.0)),
    "mode-assisted PCD without modes": _by(
        ModeAssisted(inner=PCD(k=2, n_chains=N_CHAINS), mode=GroundState(solver=BruteForce()), schedule=NEVER)
    ),
}
GROUND_STATES = {
    "brute force": GroundState(solver=BruteForce()),
    "annealing": GroundState(solver=GibbsAnnealing(n_restarts=4)),
    "blocks": BlockAnnealing(n_chains=8, n_sweeps=20),
}


def _ground_states(model: Model, seed: int) -> Iterator[str]:
    lowest = float(enumerated(model).energy.min())
    for name, sampler in GROUND_STATES.items():
        stream = rng.stream(seed, "negative_phase")
        found = sampler.sample(model, sampler.init(model, 1, generator=stream), None, generator=stream)
        at_means = at_real_means(model, found.configurations)
        model.visible.check(at_means.v)
        energy = float(model.energy(at_means.v, at_means.h).detach().min())
        slack = 1e-4 * (1 + abs(lowest))
        if energy < lowest - slack or (name == "brute force" and energy > lowest + slack):
            yield f"ground state by {name}: energy {energy}, and {lowest} of all states"


def _annealed(model: Model, seed: int) -> Iterator[str]:
    if not isinstance(model, RBM):
        return
    true, generator = log_partition_function(model), rng.stream(seed, "annealing")
    base = base_of(rows_of(model, 30, generator), model.visible)
    up = Ais(n_chains=200, n_betas=40).estimate(model, generator=generator, base=base)
    samples = exact_samples(model, 200, generator=generator)
    down = ReverseAis(n_betas=40).estimate(model, samples, generator=generator, base=base)
    for name, found in (("AIS", up), ("reverse AIS", down)):
        trusted = float(found.effective_sample_size) > 50
        if trusted and float((found.log_z - true).abs()) > MOST_ERRORS * float(found.standard_error) + TOLERANCE:
            yield f"{name}: log Z {float(found.log_z)} ± {float(found.standard_error)}, and {float(true)} exactly"


# ------------------------------------------------------------------------------------------------- the campaign


def attempt(case: str) -> ledger.Outcome:
    """One model; every tenth with all samplers, too."""
    torch.set_num_threads(1)
    number = int(case.rpartition("/")[2])
    random = rng.stream(zlib.crc32(case.encode()), "random model")
    findings: list[str] = []
    kind, model = model_of(random)
    name = f"{kind}, {type(model.visible).__name__} x {type(model.hidden).__name__}"
    try:
        findings += check_exact(model, random)
        if number % 10 == 0:
            findings += check_drawn(model, random)
    except Exception as error:
        findings.append(f"{type(error).__name__}: {error}")
    return ledger.Outcome(kind=kind, findings=[f"{name}: {found}" for found in findings])


def main() -> int:
    arguments = ledger.parser(__doc__, count=10_000, what="models").parse_args()
    cases = [f"model/{number:05d}" for number in range(arguments.count)]
    return ledger.run(arguments.out, cases, attempt, workers=arguments.workers)


if __name__ == "__main__":
    sys.exit(main())
