"""What two_nodes.py starts in each process: a training whose weights are kept, or whose messages are counted."""

import json
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import lightning.pytorch as pl
import torch
from torch import Generator, Tensor
from torch.distributed.algorithms.ddp_comm_hooks import default_hooks

from memcomp_lightning import rng
from memcomp_lightning.data import Batches, Table, TableDataModule
from memcomp_lightning.data.module import RowsDataModule
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.models import DBN
from memcomp_lightning.models.units import Bernoulli, Categorical, Units
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.objective import shares
from memcomp_lightning.samplers import CD, PCD, GroundState, ModeAssisted, ModeSchedule
from memcomp_lightning.solvers import AlternatingDescent
from memcomp_lightning.training import Greedy
from memcomp_lightning.types import Batch, Configurations, NegativePhase, NoState

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
        self.sizes: list[int] | None = None
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
        of_each = list(zip(self._dealt(positive.v), self._dealt(positive.h), strict=True))
        for (v, h), own, numbers in zip(of_each, state, self.generators, strict=False):
            found.append(self.sampler.sample(model, own, Configurations(v, h), generator=numbers))
        parts = [one.configurations for one in found]
        weight = torch.cat(
            [shares(part) * len(v) / len(positive.v) for part, (v, _) in zip(parts, of_each, strict=True)]
        )
        v, h = torch.cat([part.v for part in parts]), torch.cat([part.h for part in parts])
        return NegativePhase(Configurations(v, h, weight), States(*(one.state for one in found)), {})

    def _dealt(self, x: Tensor) -> Sequence[Tensor]:
        """Rows of each process: every n-th, or so many one after the other."""
        return [x[rank :: self.n] for rank in range(self.n)] if self.sizes is None else x.split(self.sizes)


# ------------------------------------------------------------------------------------------------- a shared table


N_SHARED = (3, 90, 40, 1, 69)
"""Rows of the files of the table that is shared: processes hold blocks of them."""


def write_parts(folder: Path) -> None:
    """A table of bits, words and numbers in files of their own."""
    folder.mkdir(exist_ok=True)
    draw = rng.stream(0, "table")
    for number, n in enumerate(N_SHARED):
        group = torch.randint(2, (n, 1), generator=draw)
        bits = (rng.uniform((n, 14), generator=draw) < 0.3 + 0.4 * group).int()
        x = group + 3 * rng.uniform((n, 2), generator=draw) + number
        words = [
            ["red", "green", "blue"][k] for k in (torch.randint(2, (n,), generator=draw) + group[:, 0]).tolist()
        ]
        lines = [",".join([*(f"b{k}" for k in range(14)), "x0", "x1", "word"])]
        lines += [
            ",".join(map(str, [*b, *y, w])) for b, y, w in zip(bits.tolist(), x.tolist(), words, strict=True)
        ]
        (folder / f"{number}.csv").write_text("\n".join(lines) + "\n")


def share_of(rank: int, n: int) -> TableDataModule:
    """The rows of a process, where n share the table."""
    table = Table(path="parts", share=(rank, n)).load()
    return TableDataModule(table, batch_size=40, validation_fraction=0.1, seed=SEED)


class OfAll:
    """In one process, the batches of n processes that share a table, each update's as one."""

    batch_sampler: ClassVar[None] = None

    def __init__(self, n: int, sampler: AsSeveral) -> None:
        self.batches: list[Batches] = [share_of(rank, n).train_batches(rank, n) for rank in range(n)]
        self.of_sampler = sampler

    @property
    def sampler(self) -> "OfAll":
        """Where Lightning says which pass begins."""
        return self

    def set_epoch(self, epoch: int) -> None:
        for batches in self.batches:
            batches.set_epoch(epoch)

    def __len__(self) -> int:
        return len(self.batches[0])

    def __iter__(self) -> Iterator[Batch]:
        for parts in zip(*self.batches, strict=True):
            self.of_sampler.sizes = [len(part.label) for part in parts]
            v, label = torch.cat([part.v for part in parts]), torch.cat([part.label for part in parts])
            yield Batch(v, label, 1.0, True, None, None)


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
    shared = model == "shared table"
    if shared and not together:
        write_parts(Path("parts"))
    for precision in ("32-true", "64-true"):
        if shared:
            own_rows = share_of(int(os.environ["RANK"]) if together else 0, n)
            units, sampler, rows = own_rows.units, PCD(n_chains=8), torch.empty(0)
        else:
            units, sampler, rows = case(model)
        dbn = DBN(visible=units, hidden_sizes=[8, 6], generator=rng.stream(0, "weights"))
        kept["begin"] = {name: tensor.clone() for name, tensor in dbn.state_dict().items()}
        own = sampler if together else AsSeveral(sampler, n)
        module = EnergyPretraining(Greedy(dbn), own, iterations=PASSES, seed=SEED)
        if not together:
            own.begin()
        trainer = trainer_of(n if together else 1, 2 * PASSES, precision=precision)
        if not shared:
            trainer.fit(module, datamodule=data_of(units, rows, BATCH))
        elif together:
            trainer.fit(module, datamodule=own_rows)
        else:
            trainer.fit(module, OfAll(n, own))
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
