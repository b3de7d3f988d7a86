"""Peers of the comparison: programs that fit a density of their own kind and say what it is worth.

``PROGRAM --list`` writes a JSON object: for each peer its ``label``, the ``axes`` of its settings with the values
of each in rising order, a ``start``, and ``missing``, what to install before it runs, null if nothing.

``PROGRAM NAME --train F --valid F --test F --settings JSON --seed N --out FILE`` fits one, and writes a JSON
object into FILE: ``valid`` and ``test``, the mean log-likelihoods of rows in nats, and ``seconds`` of the
processor. A peer that cannot tell its likelihood writes ``weights`` instead, an .npz of an RBM: ``weight``
(n_hidden, n_visible), ``b`` and ``c``. Where a setting is chosen the test number is not looked at.
"""

import json
import logging
import math
import os
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from memcomp_lightning.array_files import opened_arrays
from memcomp_lightning.errors import UserError
from memcomp_lightning.interop.parameters import rbm_of, tensor_of
from memcomp_lightning.studies.accuracy import Progress
from memcomp_lightning.studies.density.trial import scores_of
from memcomp_lightning.studies.records import Named, Record
from memcomp_lightning.studies.search import Axes, Setting, checked_start

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Peer:
    """A density of another kind, and what is searched for it."""

    label: str
    axes: Axes
    start: Setting


def peers_of(python: str, program: str) -> dict[str, Peer]:
    """Ask a program which peers it has.

    Raises:
        UserError: It does not answer as it should, or a package is missing.
    """
    answer = _run(python, program, "--list")
    try:
        found = cast(Mapping[str, Mapping[str, Any]], json.loads(answer))
        lacking = [f"{name}: {own['missing']}" for name, own in found.items() if own.get("missing")]
        peers = {
            name: Peer(label=own["label"], axes=own["axes"], start=checked_start(own["axes"], own["start"], name))
            for name, own in found.items()
            if not own.get("missing")
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"density.peers={program}: --list gave no JSON of peers ({error!r}): {answer[:80]!r}"
        ) from error
    if not peers:
        raise UserError(f"density.peers={program}: nothing that its peers need is installed. {'; '.join(lacking)}")
    return peers


@dataclass(frozen=True, kw_only=True)
class PeerTrial(Named):
    """A fit of a peer.

    Attributes:
        python, program: What runs it.
        files: Of training, held-out and test rows.
        betas, chains: Of AIS, where the peer is an RBM.
    """

    python: str
    program: str
    files: tuple[str, str, str]
    betas: int
    chains: int

    @property
    def n_updates(self) -> int:
        """Of the progress bar: it counts fits."""
        return 1

    @property
    def title(self) -> str:
        """For people."""
        return f"{self.data_set}, {self.method}, {self.setting}"

    def run(self, progress: Progress) -> list[Record]:
        """Fit it in a process of its own, with one thread.

        Not every setting suits every table (some learners split no table of few rows): while a setting is being
        chosen, one that cannot be fitted loses.
        """
        progress(self.title, 0)
        try:
            record = self._fitted()
        except UserError as error:
            if not self.choosing:
                raise
            log.warning("%s: this setting is left out: %s", self.title, error)
            record = replace(Record.of(self, at=[], seconds=[], measures={}), held_out=-math.inf)
        progress(self.title, 1)
        return [record]

    def _fitted(self) -> Record:
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "answer.json"
            named = [
                part for pair in zip(("--train", "--valid", "--test"), self.files, strict=True) for part in pair
            ]
            _run(
                *(self.python, self.program, self.method, *named),
                *("--settings", self.setting, "--seed", str(self.seed), "--out", str(out)),
            )
            try:
                answer = json.loads(out.read_text(encoding="utf-8"))
                if "weights" in answer:
                    answer |= self._judged(Path(answer["weights"]))
                numbers = {name: float(answer[name]) for name in ("valid", "test", "seconds")}
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise UserError(
                    f"{self.program} {self.method}: the answer is not as it should be: {error!r}"
                ) from error
        measures = {"valid": [[numbers["valid"]]]}
        if not self.choosing:
            test, reverse = numbers["test"], answer.get("test_reverse", numbers["test"])
            measures |= {"valid_best": [[numbers["valid"]]], "test": [[test]], "test_reverse": [[reverse]]}
            measures |= {"standard_error": [[answer.get("standard_error", 0.0)]]}
        record = Record.of(self, at=[1], seconds=[numbers["seconds"]], measures=measures)
        return replace(record, held_out=numbers["valid"])

    def _judged(self, weights: Path) -> dict[str, float]:
        """What an RBM says of the rows."""
        with opened_arrays(weights) as arrays:
            weight, b, c = (tensor_of(arrays[name], name) for name in ("weight", "b", "c"))
        rbm = rbm_of(weight, b, c)
        train, valid, test = (read_rows(file) for file in self.files)
        of_valid, of_test = scores_of(rbm, train, [valid, test], self.betas, self.chains)
        error = {"standard_error": float(of_test.standard_error)}
        return {
            "valid": float(of_valid.least),
            "test": float(of_test.up),
            "test_reverse": float(of_test.down),
            **error,
        }


def read_rows(file: str) -> torch.Tensor:
    """Rows of 0 and 1 of a CSV file without a header."""
    return torch.from_numpy(np.loadtxt(file, delimiter=",", dtype=np.float32, ndmin=2))


def _run(*command: str) -> str:
    """What a program prints; its last line of complaint if it fails."""
    own = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    try:
        done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **own}, check=False)
    except OSError as error:
        raise UserError(f"density.peers_python={command[0]}: {error.strerror or error}") from error
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip() or f"status {done.returncode}").splitlines()[-1]
        raise UserError(f"{' '.join(command[1:3])}: {last}")
    return done.stdout
