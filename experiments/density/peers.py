"""Other density models of a binary table: fits one, and says how likely held-out rows are.

    PEERS/bin/python experiments/density/peers.py --list
    PEERS/bin/python experiments/density/peers.py masked --train plants.train.csv.gz --valid plants.valid.csv.gz \\
        --test plants.test.csv.gz --settings '{"masks": 8, "hidden": 100}' --seed 0 --out masked.json

PEERS is an environment of its own, without memcomp_lightning:

    python -m venv PEERS
    PEERS/bin/pip install torch==2.13.0
    PEERS/bin/pip install -r experiments/density/peers.txt
    PEERS/bin/pip install --no-deps deeprob-kit==1.1.0

The last one stands alone because it asks for torchvision, which nothing here uses.

`--list` prints a JSON object, name -> {"label": for people, "axes": {setting: [values in order]}, "start":
{setting: value}, "likelihood": "exact" or "rbm", "missing": null or the pip line of what is not installed}. Axes
stand in the order in which to search them.

Files are CSV or CSV.gz of 0 and 1 without a header. A fit sees the training rows; where it goes on step by step,
the validation rows say when to stop, and the best step is kept. Settings that `--settings` leaves out are those of
"start". `--out` gets {"valid": mean log-likelihood of a validation row in nats, "test": of a test row, "seconds":
of the processor for the fit alone, "note": text}. For "rbm", whose partition function others estimate, it gets
{"weights": path of an .npz with weight (n_hidden, n_visible), b, c, "seconds", "note"}. All work is that of one
thread. Errors of a user are one line, with exit status 2.
"""

import argparse
import importlib
import importlib.util
import json
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

Setting = int | float | str

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Peer:
    """A model that can be fitted.

    Attributes:
        label: For people.
        fit: "module:function" beside this file; called with the rows, the seed and all settings.
        axes: Values of each setting that are worth a try, in order, the most important setting first.
        start: Where a search begins.
        needs: Modules to import, each with what to pip install for it.
        likelihood: "exact", or "rbm" if only weights are given.
    """

    label: str
    fit: str
    axes: dict[str, list[Setting]]
    start: dict[str, Setting]
    needs: dict[str, str]
    likelihood: str = "exact"

    def missing(self) -> str | None:
        """The pip line that brings what is not installed."""
        wanted = [what for module, what in self.needs.items() if importlib.util.find_spec(module) is None]
        return f"pip install {' '.join(wanted)}" if wanted else None


_NUMPY = {"numpy": "numpy"}
_SCIPY = _NUMPY | {"scipy": "scipy"}
_DEEPROB = _SCIPY | {
    "torch": "torch==2.13.0",
    "sklearn": "scikit-learn",
    "networkx": "networkx",
    "tqdm": "tqdm",
    "joblib": "joblib",
    "matplotlib": "matplotlib",
    "pydot": "pydot",
    "deeprob": "--no-deps deeprob-kit==1.1.0",
}

PEERS = {
    "independent": Peer(
        "independent bits",
        "bits:independent",
        {"pseudocount": [0.1, 1.0, 2.0]},
        {"pseudocount": 1.0},
        _NUMPY,
    ),
    "chow_liu": Peer(
        "Chow-Liu tree",
        "trees:chow_liu",
        {"pseudocount": [0.01, 0.1, 1.0, 10.0]},
        {"pseudocount": 0.1},
        _SCIPY,
    ),
    "mixture": Peer(
        "mixture of Bernoullis (EM)",
        "bits:mixture",
        {"components": [10, 30, 100, 300], "pseudocount": [0.1, 1.0, 3.0]},
        {"components": 100, "pseudocount": 1.0},
        _NUMPY,
    ),
    "sum_product": Peer(
        "sum-product network (LearnSPN, deeprob-kit)",
        "circuits:sum_product",
        {
            "min_rows": [50, 100, 200, 500],
            "leaf": ["mle", "binary-clt"],
            "threshold": [5.0, 10.0, 20.0],
            "smoothing": [0.01, 0.1, 1.0],
        },
        {"min_rows": 200, "leaf": "binary-clt", "threshold": 10.0, "smoothing": 0.1},
        _DEEPROB,
    ),
    "cutset_ensemble": Peer(
        "ensemble of cutset networks (deeprob-kit)",
        "circuits:cutset_ensemble",
        {
            "min_rows": [64, 128, 256, 512],
            "networks": [10, 30, 100],
            "cut": [1, 2, 3],
            "smoothing": [0.01, 0.1, 1.0],
        },
        {"min_rows": 128, "networks": 30, "cut": 1, "smoothing": 0.01},
        _DEEPROB,
    ),
    "hidden_tree": Peer(
        "hidden Chow-Liu tree (EM)",
        "hidden_tree:hidden_tree",
        {"states": [4, 8, 16, 32], "pseudocount": [0.1, 1.0, 3.0]},
        {"states": 8, "pseudocount": 1.0},
        _SCIPY,
    ),
    "masked": Peer(
        "masked autoregressive network (MADE)",
        "masked:masked",
        {
            "masks": [1, 8, 32],
            "rate": [3e-4, 1e-3, 3e-3],
            "hidden": [100, 500, 1000],
            "decay": [0.01, 0.1, 0.3],
        },
        {"masks": 32, "rate": 1e-3, "hidden": 500, "decay": 0.01},
        _NUMPY | {"torch": "torch==2.13.0"},
    ),
    "sklearn_rbm": Peer(
        "scikit-learn's RBM",
        "boltzmann:rbm",
        {"n_components": [25, 100, 400], "learning_rate": [0.02, 0.05, 0.1], "n_iter": [10, 50, 200]},
        {"n_components": 100, "learning_rate": 0.05, "n_iter": 50},
        _NUMPY | {"sklearn": "scikit-learn"},
        likelihood="rbm",
    ),
}


def refuse(message: str) -> NoReturn:
    """Ends the program with one line."""
    print(message, file=sys.stderr)
    raise SystemExit(2)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        refuse(f"{self.prog}: {message}; see {self.prog} --help")


def listed() -> dict[str, dict[str, Any]]:
    """What `--list` prints."""
    return {
        name: {
            "label": peer.label,
            "axes": peer.axes,
            "start": peer.start,
            "likelihood": peer.likelihood,
            "missing": peer.missing(),
        }
        for name, peer in PEERS.items()
    }


def settings_of(peer: Peer, text: str) -> dict[str, Setting]:
    """All settings of a fit: those of the JSON object ``text``, and for the others the peer's start."""
    try:
        given = json.loads(text)
    except json.JSONDecodeError as error:
        refuse(f"--settings {text}: not JSON ({error}); write for example '{json.dumps(peer.start)}'")
    if not isinstance(given, dict):
        refuse(f"--settings {text}: not a JSON object; write for example '{json.dumps(peer.start)}'")
    for name, value in given.items():
        if name not in peer.start:
            refuse(f"--settings {name}: no such setting; there are {', '.join(peer.start)}")
        kind = type(peer.start[name])
        if kind is str and value not in peer.axes[name]:
            refuse(f"--settings {name}={value}: not one of {', '.join(map(str, peer.axes[name]))}")
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if kind is not str and not (is_number and 0 < value < float("inf") and kind(value) == value):
            refuse(f"--settings {name}={value}: not {'a whole' if kind is int else 'a'} number above 0")
    return {name: type(value)(given.get(name, value)) for name, value in peer.start.items()}


def read_rows(file: Path) -> Any:
    """A table of 0 and 1 as uint8, (rows, columns)."""
    import warnings

    import numpy as np

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of an empty file; it is refused below
            rows = np.loadtxt(file, delimiter=",", dtype=np.float32, ndmin=2)
    except FileNotFoundError:
        refuse(f"{file}: no such file")
    except (OSError, ValueError) as error:
        refuse(
            f"{file}: not a table of 0 and 1, separated by commas, without a header ({error})".replace("\n", " ")
        )
    if rows.size == 0:
        refuse(f"{file}: no rows")
    if not ((rows == 0) | (rows == 1)).all():
        refuse(f"{file}: holds {rows[(rows != 0) & (rows != 1)][0]:g}; only 0 and 1 are allowed")
    return rows.astype(np.uint8)


def fitted(
    peer: Peer, files: dict[str, Path], settings: dict[str, Setting], seed: int, out: Path
) -> dict[str, Any]:
    """What `--out` gets; the weights of an RBM are written beside it."""
    import numpy as np

    rows = {split: read_rows(file) for split, file in files.items()}
    for split, part in rows.items():
        if part.shape[1] != rows["train"].shape[1]:
            refuse(f"{files[split]}: {part.shape[1]} columns, but {files['train']} has {rows['train'].shape[1]}")
    module, function = peer.fit.split(":")
    fit = getattr(importlib.import_module(module), function)
    begun = time.process_time()
    found = fit(rows["train"], rows["valid"], seed=seed, **settings)
    seconds = time.process_time() - begun
    if peer.likelihood == "rbm":
        weights = out.with_suffix(".npz")
        np.savez(weights, **found)
        return {"weights": str(weights), "seconds": seconds, "note": ""}
    means = {split: float(found.log_likelihood(rows[split]).mean()) for split in ("valid", "test")}
    return {**means, "seconds": seconds, "note": found.note}


def main(arguments: list[str] | None = None) -> None:
    parser = _Parser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("name", nargs="?", help="of the peer")
    parser.add_argument("--list", action="store_true", help="print all peers and their settings as JSON")
    for split in ("train", "valid", "test"):
        parser.add_argument(f"--{split}", type=Path, help="CSV of 0 and 1, perhaps .gz")
    parser.add_argument("--settings", default="{}", help="JSON object; without it the peer's start")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args(arguments)
    if given.list:
        print(json.dumps(listed(), indent=2))
        return
    if given.name not in PEERS:
        refuse(f"{given.name or 'no peer named'}: not a peer; there are {', '.join(PEERS)}")
    files = {split: getattr(given, split) for split in ("train", "valid", "test")}
    absent = [f"--{name}" for name, value in {**files, "out": given.out}.items() if value is None]
    if absent:
        refuse(f"{', '.join(absent)}: needed; see --help")
    if given.seed < 0:
        refuse(f"--seed {given.seed}: not a whole number from 0 on")
    if not given.out.parent.is_dir():
        refuse(f"--out {given.out}: no folder {given.out.parent}")
    peer = PEERS[given.name]
    settings = settings_of(peer, given.settings)
    if missing := peer.missing():
        refuse(f"{given.name} needs packages that are not installed: {missing}")
    # Before numpy and torch are imported, which read them once.
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    written = fitted(peer, files, settings, given.seed, given.out)
    partial = given.out.with_name(f"{given.out.name}.partial")
    partial.write_text(json.dumps(written, indent=2) + "\n")
    partial.replace(given.out)


if __name__ == "__main__":
    main()
