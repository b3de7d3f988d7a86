"""What two_nodes.py starts in each process: a training whose weights are kept, or whose messages are counted."""

import json
import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import lightning.pytorch as pl
import torch
from torch import Generator, Tensor
from torch.distributed.algorithms.ddp_comm_hooks import default_hooks

from memcomp_lightning import rng
from memcomp_lightning.data.module import RowsDataModule
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.models import DBN
from memcomp_lightning.models.units import Bernoulli, Categorical, Units
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.objective import shares
from memcomp_lightning.samplers import CD, PCD, GroundState, ModeAssisted, ModeSchedule
from memcomp_lightning.solvers import AlternatingDescent
from memcomp_lightning.training import Greedy
from memcomp_lightning.types import Configurations, NegativePhase, NoState

N_ROWS, BATCH, PASSES, SEED = 96, 48, 6, 0
SIZES = (3, 4, 2, 5)
WARM, COUNTED = 10, 40
"""Updates before the counting, and those that are counted."""


class States(NamedTuple):
    """What each process keeps; there are four at most."""

    first: Any = NoState()
    second: Any = NoState()
    third: Any = NoState()
    fourth: Any = NoState()


class AsSeveral:
    """In one process, a sampler as each of n processes would have it: own rows, own chains, own random numbers."""

    shared: ClassVar[bool] = False

    def __init__(self, sampler: Any, n: int) -> None:
        self.sampler, self.n, self.uses_data = sampler, n, sampler.uses_data
        self.begin()

    def begin(self) -> None:
        """Start the random numbers afresh: a stage tries its sampler before it trains."""
        self.generators = [rng.stream(SEED, "negative_phase", rank) for rank in range(self.n)]

    def init(self, model: Any, n_chains: int, *, generator: Generator) -> States:
        return States(*(self.sampler.init(model, n_chains // self.n, generator=own) for own in self.generators))

    def sample(
        self, model: Any, state: States, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[Any]:
        found = []
        for rank, (own, numbers) in enumerate(zip(state, self.generators, strict=False)):
            part = Configurations(positive.v[rank :: self.n], positive.h[rank :: self.n])
            found.append(self.sampler.sample(model, own, part, generator=numbers))
        parts = [one.configurations for one in found]
        v, h = torch.cat([part.v for part in parts]), torch.cat([part.h for part in parts])
        weight = torch.cat([shares(part) for part in parts]) / self.n
        return NegativePhase(Configurations(v, h, weight), States(*(one.state for one in found)), {})


def case(model: str) -> tuple[Units, Any, Tensor]:
    """Units, sampler and rows of a case."""
    generator = rng.stream(0, "rows")
    if model == "categories":
        first = torch.randint(3, (N_ROWS,), generator=generator)
        others = [torch.where(rng.uniform((N_ROWS,), generator=generator) < 0.7, first % k, 0) for k in SIZES[1:]]
        return Categorical(SIZES), PCD(n_chains=8), torch.stack([first, *others], dim=-1).float()
    patterns = (rng.uniform((4, 20), generator=generator) < 0.5).float()[torch.arange(N_ROWS) % 4]
    noise = rng.uniform((N_ROWS, 20), generator=generator) < 0.1
    mode = GroundState(solver=AlternatingDescent(n_restarts=4))
    samplers = {
        "cd": CD(),
        "pcd": PCD(n_chains=8),
        "mode_assisted": ModeAssisted(
            inner=PCD(n_chains=8), mode=mode, schedule=ModeSchedule(n_updates=PASSES * 2, p_max=0.9)
        ),
    }
    return Bernoulli(20), samplers[model], torch.where(noise, 1 - patterns, patterns)


def data_of(units: Units, rows: Tensor, batch_size: int) -> RowsDataModule:
    made = Rows(rows, torch.full((len(rows),), -1))
    return RowsDataModule(made, made, units=units, n_classes=0, name="made", batch_size=batch_size)


def trainer_of(n: int, n_epochs: int, **settings: Any) -> pl.Trainer:
    several = {"devices": n // 2, "num_nodes": 2, "strategy": "ddp"} if n > 1 else {"devices": 1}
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    given = {"accelerator": "cpu", "max_epochs": n_epochs, "enable_model_summary": False, **several, **quiet}
    return pl.Trainer(**{**given, **settings})


def weights(model: str, n: int, place: Path, *, together: bool) -> None:
    """Train in both precisions; keep the weights."""
    kept: dict[str, Any] = {"updates": 0}
    for precision in ("32-true", "64-true"):
        units, sampler, rows = case(model)
        dbn = DBN(visible=units, hidden_sizes=[8, 6], generator=rng.stream(0, "weights"))
        kept["begin"] = {name: tensor.clone() for name, tensor in dbn.state_dict().items()}
        own = sampler if together else AsSeveral(sampler, n)
        module = EnergyPretraining(Greedy(dbn), own, iterations=PASSES, seed=SEED)
        if not together:
            own.begin()
        trainer = trainer_of(n if together else 1, 2 * PASSES, precision=precision)
        trainer.fit(module, datamodule=data_of(units, rows, BATCH))
        kept[precision] = dbn.state_dict()
        kept["updates"] = trainer.global_step
        first = trainer.is_global_zero
    if first:
        torch.save(kept, place)


class Count(pl.Callback):
    """Counts what collective operations carry, and what the card sends, over some updates."""

    def __init__(self, place: Path) -> None:
        self.place, self.operations, self.bytes, self.n_done = place, 0, 0, 0
        self.by_name: dict[str, int] = {}
        self.before: dict[str, float] = {}

    def add(self, name: str, n_bytes: int) -> None:
        self.operations, self.bytes = self.operations + 1, self.bytes + n_bytes
        self.by_name[f"{name} {n_bytes}"] = self.by_name.get(f"{name} {n_bytes}", 0) + 1

    def now(self) -> dict[str, float]:
        card = Path("/sys/class/net/va/statistics")
        sent = {"sent": 0, "packets": 0}
        with suppress(OSError):
            sent = {
                name: int((card / f"tx_{what}").read_text())
                for name, what in (("sent", "bytes"), ("packets", "packets"))
            }
        return {"operations": self.operations, "bytes": self.bytes, "seconds": time.perf_counter(), **sent}

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Let gradients be added up from Python, where it is counted; what happens is what happens without."""
        if trainer.world_size > 1:
            trainer.strategy.model.register_comm_hook(None, default_hooks.allreduce_hook)

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        self.n_done += 1
        if self.n_done == WARM:
            self.by_name.clear()
            self.before = self.now()
        if self.n_done == WARM + COUNTED and trainer.is_global_zero:
            facts = {name: (after - self.before[name]) / COUNTED for name, after in self.now().items()}
            self.place.write_text(
                json.dumps({"facts": facts, "by_name": self.by_name, "host": socket.gethostname()})
            )


def counted(count: Count) -> None:
    """Let every collective operation of torch.distributed be counted, and then do what it did."""
    inside = torch.distributed.distributed_c10d
    for name in ("all_reduce", "broadcast", "all_gather", "reduce", "gather", "barrier"):
        original = getattr(inside, name)

        def counting(
            *given: Any, _name: str = name, _original: Callable[..., Any] = original, **named: Any
        ) -> Any:
            tensor = named.get("tensor", given[0] if given else None)
            count.add(_name, tensor.numel() * tensor.element_size() if isinstance(tensor, Tensor) else 0)
            return _original(*given, **named)

        setattr(inside, name, counting)
        setattr(torch.distributed, name, counting)


def costs(sampler: str, size: str, n: int, place: Path) -> None:
    n_visible, n_hidden = map(int, size.split("x"))
    samplers = {
        "cd": CD(),
        "pcd": PCD(n_chains=16),
        "ground_state": GroundState(solver=AlternatingDescent(n_restarts=2)),
    }
    rows = (rng.uniform((64 * (WARM + COUNTED + 2), n_visible), generator=rng.stream(0, "rows")) < 0.2).float()
    dbn = DBN(n_visible, [n_hidden], generator=rng.stream(0, "weights"))
    module = EnergyPretraining(Greedy(dbn), samplers[sampler], iterations=1, seed=SEED)
    count = Count(place)
    counted(count)
    settings: dict[str, Any] = {"callbacks": [count]}
    trainer_of(n, 1, **settings).fit(module, datamodule=data_of(Bernoulli(n_visible), rows, 64))


if __name__ == "__main__":
    torch.set_num_threads(1)
    what, model, *rest, file = sys.argv[1:]
    if what == "count":
        costs(model, rest[0], int(rest[1]), Path(file).absolute())
    else:
        weights(model, int(rest[0]), Path(file).absolute(), together=what == "together")
