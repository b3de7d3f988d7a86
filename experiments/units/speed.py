"""An epoch with categorical units and with real ones, beside a torch loop written by hand for the same update."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from functools import partial
from statistics import median
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Generator, Tensor
from torch.optim import SGD

from memcomp_lightning import rng
from memcomp_lightning.data import Batches
from memcomp_lightning.models import DBN
from memcomp_lightning.models.units import Categorical, Gaussian, Units
from memcomp_lightning.products import quick_products
from memcomp_lightning.samplers import CD, PCD
from memcomp_lightning.training import Greedy, pretrain

RATE, BATCH = 0.01, 100
Draw = Callable[[Tensor, Generator], Tensor]
"""States of fields, ``(n, n_sites, q)`` to ``(n, n_sites)``."""


def multinomial(field: Tensor, generator: Generator) -> Tensor:
    p = F.softmax(field, dim=-1)
    return torch.multinomial(p.flatten(0, 1), 1, generator=generator).view(field.shape[:-1])


def gumbel(field: Tensor, generator: Generator) -> Tensor:
    noise = torch.empty_like(field).exponential_(generator=generator).log_()
    return torch.sub(field, noise).argmax(-1)


def race(field: Tensor, generator: Generator) -> Tensor:
    noise = torch.empty_like(field).exponential_(generator=generator)
    return F.softmax(field, dim=-1).div_(noise).argmax(-1)


def inversion(field: Tensor, generator: Generator) -> Tensor:
    below = F.softmax(field, dim=-1).cumsum(-1)
    u = torch.empty(field.shape[:-1]).uniform_(generator=generator) * below[..., -1]
    return (below <= u.unsqueeze(-1)).sum(-1).clamp_(max=field.shape[-1] - 1)


def search(field: Tensor, generator: Generator) -> Tensor:
    below = F.softmax(field, dim=-1).cumsum(-1)
    u = torch.empty(field.shape[:-1]).uniform_(generator=generator) * below[..., -1]
    return torch.searchsorted(below, u.unsqueeze(-1), right=True).squeeze(-1).clamp_(max=field.shape[-1] - 1)


DRAWS: dict[str, Draw] = {draw.__name__: draw for draw in (multinomial, gumbel, race, inversion, search)}


class Parameters:
    """Weight ``(n_hidden, n_visible)``, biases and precisions of one RBM, without autograd."""

    def __init__(self, visible: Units, n_hidden: int) -> None:
        rbm = DBN(visible=visible, hidden_sizes=[n_hidden])[0]
        self.weight, self.b, self.c = (x.detach().clone() for x in (rbm.weight, rbm.b, rbm.c))
        self.precision = torch.ones(visible.n)

    def hidden(self, v: Tensor) -> Tensor:
        return F.linear(v, self.weight, self.c).sigmoid_()

    def field(self, h: Tensor) -> Tensor:
        return torch.addmm(self.b, h, self.weight)

    def step(self, v: Tensor, h: Tensor, v_model: Tensor, h_model: Tensor) -> None:
        """Gradient descent in place, without a gradient in memory."""
        self.weight.addmm_(h.T, v, alpha=RATE / len(v)).addmm_(h_model.T, v_model, alpha=-RATE / len(v_model))
        self.b.add_(v.mean(0) - v_model.mean(0), alpha=RATE)
        self.c.add_(h.mean(0) - h_model.mean(0), alpha=RATE)


def categorical_draw(q: int, draw: Draw) -> Callable[[Parameters, Tensor, Generator], Tensor]:
    def visible(model: Parameters, h: Tensor, generator: Generator) -> Tensor:
        field = model.field(h).unflatten(-1, (-1, q))
        state = draw(field, generator).unsqueeze(-1)
        return torch.zeros_like(field).scatter_(-1, state, 1.0).flatten(-2)

    return visible


def gaussian_draw(model: Parameters, h: Tensor, generator: Generator) -> Tensor:
    noise = torch.empty(len(h), len(model.b)).normal_(generator=generator)
    return noise.mul_(model.precision.rsqrt()).add_(model.field(h).div_(model.precision))


@torch.no_grad()
def by_hand(
    batches: Iterable[Any],
    model: Parameters,
    visible: Callable[[Parameters, Tensor, Generator], Tensor],
    *,
    chains: Tensor | None,
    precision: bool,
    generator: Generator,
) -> None:
    """One epoch of CD-1, or of PCD-1 where there are chains."""
    for batch in batches:
        v = batch.v
        h = model.hidden(v)
        before = h if chains is None else model.hidden(chains)
        drawn = torch.empty_like(before).uniform_(generator=generator).lt_(before)
        v_model = visible(model, drawn, generator)
        if chains is not None:
            chains = v_model
        h_model = model.hidden(v_model)
        model.step(v, h, v_model, h_model)
        if precision:
            squares = v.square().mean(0).sub_(v_model.square().mean(0))
            model.precision.sub_(squares, alpha=RATE / 2).clamp_(0.05, 1e4)


CASES: dict[str, tuple[Callable[[], Units], Callable[[], Units]]] = {
    "categorical": (lambda: Categorical(500, q=21), lambda: Categorical(10, q=5)),
    "Gaussian": (lambda: Gaussian(1000), lambda: Gaussian(20)),
}
"""Units to measure, and smaller ones to try it."""

SAMPLERS = {"CD-1": CD(k=1), "PCD-1": PCD(k=1, n_chains=BATCH)}


class Seconds(NamedTuple):
    """Of an epoch."""

    wall: float
    cpu: float


def timed(run: Callable[[], None]) -> Seconds:
    wall, cpu = time.perf_counter(), time.process_time()
    run()
    return Seconds(time.perf_counter() - wall, time.process_time() - cpu)


def data_of(units: Units, n_rows: int) -> Tensor:
    """Random rows: what they hold does not matter for time."""
    return units.sample(torch.zeros(n_rows, units.n), generator=rng.stream(0, "data"))


def batches_of(v: Tensor) -> Batches:
    return Batches(v, torch.zeros(len(v), dtype=torch.long), BATCH, len(v), shuffle=True, seed=0)


def ours(units: Units, n_hidden: int, sampler: str, v: Tensor) -> tuple[Seconds, DBN]:
    """Seconds of an epoch by ``pretrain``, and what it trained."""
    dbn = DBN(visible=units, hidden_sizes=[n_hidden])
    optimizer = partial(SGD, lr=RATE)
    training = pretrain(Greedy(dbn), batches_of(v), SAMPLERS[sampler], iterations=1, optimizer=optimizer)
    return timed(lambda: [*training] and None), dbn


def theirs(
    units: Units, n_hidden: int, sampler: str, v: Tensor, draw: Draw, *, same_products: bool = False
) -> tuple[Seconds, Parameters]:
    """Seconds of an epoch of the loop by hand, and what it trained; as torch multiplies, or as ours does."""
    model, real = Parameters(units, n_hidden), isinstance(units, Gaussian)
    visible = gaussian_draw if real else categorical_draw(units.n // units.n_sites, draw)
    generator = rng.stream(0, "negative_phase")
    begin = None if sampler == "CD-1" else torch.zeros(BATCH, units.n)
    chains = None if begin is None else units.sample(begin, generator=generator)

    def run() -> None:
        with quick_products(BATCH * model.weight.numel()) if same_products else nullcontext():
            by_hand(batches_of(v), model, visible, chains=chains, precision=real, generator=generator)

    return timed(run), model


def case(units: Units, n_hidden: int, sampler: str, v: Tensor, repeats: int) -> dict[str, Any]:
    """Medians of repetitions that take turns; the quickest loop by hand counts."""
    runs: dict[str, Callable[[], Seconds]] = {"ours": lambda: ours(units, n_hidden, sampler, v)[0]}
    for label in ["inversion"] if isinstance(units, Gaussian) else DRAWS:
        runs[label] = partial(lambda draw: theirs(units, n_hidden, sampler, v, draw)[0], DRAWS[label])
    draw = DRAWS["inversion" if isinstance(units, Gaussian) else "search"]
    same = partial(theirs, units, n_hidden, sampler, v, draw, same_products=True)
    runs["same products"] = lambda: same()[0]
    for run in runs.values():  # warms up
        run()
    seconds = {label: list[Seconds]() for label in runs}
    for _ in range(repeats):
        for label, run in runs.items():
            seconds[label].append(run())
    wall, cpu = ({label: [x[k] for x in spent] for label, spent in seconds.items()} for k in (0, 1))
    others = [label for label in runs if label not in ("ours", "same products")]
    best = min(others, key=lambda label: median(cpu[label]))
    ratios = [a / b for a, b in zip(wall["ours"], wall[best], strict=True)]
    row: dict[str, Any] = {"ours_s": median(wall["ours"]), "by_hand_s": median(wall[best])}
    row |= {"ratio": median(ratios), "ratio_least": min(ratios), "ratio_most": max(ratios)}
    row |= {"cpu_ratio": median(a / b for a, b in zip(cpu["ours"], cpu[best], strict=True))}
    row["draws_by_hand"] = "" if isinstance(units, Gaussian) else best
    both = zip(cpu["ours"], cpu.pop("same products"), strict=True)
    row["cpu_ratio_same_products"] = median(a / b for a, b in both)
    return row | {f"{label}_cpu_s": median(spent) for label, spent in cpu.items()}


def measure(*, quick: bool, repeats: int = 7, threads: Iterable[int] = (1, 2)) -> Iterator[dict[str, Any]]:
    """A row a case, sampler and number of threads."""
    n_hidden, n_rows = (20, 200) if quick else (200, 2000)
    before = torch.get_num_threads()
    for n_threads in threads:
        torch.set_num_threads(n_threads)
        for name, makes in CASES.items():
            units = makes[quick]()
            v = data_of(units, n_rows)
            for sampler in SAMPLERS:
                row = {"units": name, "sampler": sampler, "threads": n_threads}
                row |= case(units, n_hidden, sampler, v, 1 if quick else repeats)
                yield {key: round(x, 4) if isinstance(x, float) else x for key, x in row.items()}
    torch.set_num_threads(before)
