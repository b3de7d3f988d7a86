"""The folder of one run: settings, checkpoints, weights, result. Every file is written whole."""

import hashlib
import json
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import memcomp_lightning
from memcomp_lightning import __version__
from memcomp_lightning.errors import UserError, lost
from memcomp_lightning.files import read_json, write_json, write_text
from memcomp_lightning.runs import lock
from memcomp_lightning.runs.paths import is_path


@dataclass(frozen=True)
class RunFolder:
    """Paths and files of one run."""

    path: Path

    @property
    def result(self) -> dict[str, Any] | None:
        """What a finished run found, None if it has not finished."""
        return self._read("result.json")

    @property
    def error(self) -> dict[str, Any] | None:
        """Why the last attempt failed, None if it did not."""
        return self._read("error.json")

    @property
    def report(self) -> Path:
        """The page that a figure or a comparison ends with."""
        return self.path / "report.html"

    @property
    def finished_stages(self) -> dict[str, Any]:
        """Records of the stages that are done, by name."""
        return self._read("stages.json") or {}

    def weights(self, stage: str) -> Path:
        """The weight file that a stage leaves."""
        return self.path / "weights" / f"{stage}.pt"

    @property
    def chains(self) -> Path:
        """What pretraining leaves beside its weights, for a run that goes on from it."""
        return self.path / "weights" / "pretrain_chains.pt"

    @property
    def history(self) -> list[dict[str, Any]]:
        """The runs that this one goes on from, the oldest first."""
        return list((self._read("history.json") or {}).get("runs", []))

    def keep_history(self, runs: Sequence[Mapping[str, object]]) -> None:
        """Write which runs this one goes on from, as :attr:`history` reads them."""
        write_json(self.path / "history.json", {"runs": list(runs)})

    def checkpoint(self, stage: str) -> Path:
        """The checkpoint that a stage goes on from."""
        return self.path / "checkpoints" / stage / "last.ckpt"

    @property
    def overrides(self) -> list[str] | None:
        """The command line that the folder was made with, None if it is not a run folder."""
        found = self._read("overrides.json")
        if found is None:
            return None
        overrides = found.get("overrides")
        if not (isinstance(overrides, list) and all(isinstance(override, str) for override in overrides)):
            raise UserError(f"{self.path / 'overrides.json'} is damaged: it holds no list of overrides.")
        return overrides

    @property
    def settings(self) -> DictConfig | None:
        """All settings of the run as they were written, None where there are none.

        Raises:
            UserError: They are damaged, too large, or use references of YAML, which could stand for anything.
        """
        path = self.path / "settings.yaml"
        if not path.is_file():
            return None
        try:
            if path.stat().st_size > _LARGEST_SETTINGS:
                raise UserError(f"{path} has more than {_LARGEST_SETTINGS} bytes: it holds no settings of a run.")
            text = path.read_text(encoding="utf-8")
            if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
                raise UserError(f"{path} refers to its own parts (*NAME), as no settings of a run do.")
            return cast(DictConfig, OmegaConf.create(text))
        except (ValueError, yaml.YAMLError, OmegaConfBaseException, RecursionError) as error:
            raise UserError(f"{path} is damaged ({type(error).__name__}): restore it.") from error

    @property
    def typed_in(self) -> Path:
        """The folder in which the run was started: relative paths in its overrides start there."""
        return Path((self._read("overrides.json") or {}).get("folder") or Path.cwd())

    @property
    def version(self) -> str:
        """Which version made it, for people."""
        begun = (self._read("overrides.json") or {}).get("memcomp_lightning")
        ended = ((self.result or {}).get("origin") or {}).get("memcomp_lightning")
        return str(begun or ended or "before 0.3.0")

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep other processes out; a UserError if one is in, or the folder cannot be written."""
        with ExitStack() as stack:
            try:
                self.path.mkdir(parents=True, exist_ok=True)
                stack.enter_context(lock.held(self.path))
            except OSError as error:
                if lost(error) is not None:
                    raise
                raise self._not_written(error) from error
            yield

    def open(self, config: DictConfig, overrides: Sequence[str]) -> None:
        """Make the folder; a UserError if it may not be written, or was made with other settings."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if (settings := self.settings) is not None:
                self._check_same(settings, config)
            else:
                typed = {"overrides": list(overrides), "folder": str(Path.cwd()), "memcomp_lightning": __version__}
                write_json(self.path / "overrides.json", typed)
                write_text(self.path / "settings.yaml", OmegaConf.to_yaml(config))
        except OSError as error:
            if lost(error) is not None:  # another folder would not help
                raise
            raise self._not_written(error) from error

    def _not_written(self, error: OSError) -> UserError:
        remedy = "choose another with hydra.run.dir=PATH"
        return UserError(f"run folder {self.path} cannot be written ({error.strerror}): {remedy}")

    def check_source(self) -> None:
        """Note which code makes the results of this folder; a UserError if other code made what is there."""
        now = {"memcomp_lightning": __version__, "source": _source(), **_machine()}
        there = self._read("origin.json")
        if there is None:
            write_json(self.path / "origin.json", now)
        elif there["source"] != now["source"]:
            raise UserError(
                f"run folder {self.path} was made by version {there['memcomp_lightning']}, source "
                f"{there['source']}; this is {__version__}, source {now['source']}. Results of different code are "
                "never mixed: choose another folder with hydra.run.dir=PATH, or go back to that version."
            )

    def keep_schema(self, schema: Mapping[str, object]) -> None:
        """Write what the units of the model stand for; a UserError if training began with something else."""
        there = self.schema
        if there is not None and there != json.loads(json.dumps(schema)):
            raise UserError(
                f"the data of run folder {self.path} have changed since its training began: other columns, words "
                "or scales than in its schema.json. Choose another folder with hydra.run.dir=PATH, or bring the "
                "data back."
            )
        write_json(self.path / "schema.json", schema)

    def keep_rows(self, fingerprints: Mapping[str, str]) -> None:
        """Write which rows these are; a UserError if training began with others."""
        if self.rows not in (None, fingerprints):
            raise UserError(
                f"the rows of run folder {self.path} have changed since its training began. Choose another folder "
                "with hydra.run.dir=PATH, or bring the data back."
            )
        write_json(self.path / "rows.json", fingerprints)

    @property
    def rows(self) -> dict[str, str] | None:
        """What was kept by :meth:`keep_rows`."""
        return self._read("rows.json")

    @property
    def schema(self) -> dict[str, Any] | None:
        """What was kept by :meth:`keep_schema`."""
        return self._read("schema.json")

    def finish_stage(self, stage: str, record: Mapping[str, object]) -> None:
        """Note that a stage is done; its checkpoint is not needed any more."""
        self._require_there()
        write_json(self.path / "stages.json", {**self.finished_stages, stage: record})
        self.forget_checkpoint(stage)

    def forget_checkpoint(self, stage: str) -> None:
        """Remove the checkpoint of a stage that is done; a kill may have come between the two."""
        self.checkpoint(stage).unlink(missing_ok=True)

    def finish(self, result: Mapping[str, object]) -> None:
        """Write the result, with what produced it."""
        self._require_there()
        origin = {"memcomp_lightning": __version__, **_machine()}
        write_json(self.path / "result.json", {**result, "origin": origin})
        self.forget_error()

    def begin(self, stages: Sequence[str]) -> None:
        """Make the folders of the stages' checkpoints."""
        self._require_there()
        for stage in stages:
            self.checkpoint(stage).parent.mkdir(parents=True, exist_ok=True)

    def _require_there(self) -> None:
        """Raise an OSError if the folder has vanished, though somebody may have made another in its place."""
        (self.path / "settings.yaml").stat()

    def fail(self, record: Mapping[str, object]) -> None:
        """Write why the run failed."""
        self.path.mkdir(parents=True, exist_ok=True)
        write_json(self.path / "error.json", record)

    def forget_error(self) -> None:
        """Note that the last attempt did not fail."""
        (self.path / "error.json").unlink(missing_ok=True)

    def _check_same(self, settings: DictConfig, config: DictConfig) -> None:
        there, now = _flat(settings), _flat(config)
        for name in sorted(there.keys() | now.keys()):
            old, new = there.get(name), now.get(name)
            if not (name.startswith(_FREE_TO_CHANGE) or old == new or self._same_path(name, old, new)):
                if self.version != __version__:
                    raise UserError(
                        f"run folder {self.path} was made by version {self.version}, with {name}={old}; in this "
                        f"one, {__version__}, it is {new}. Go on with that version, or begin anew in another "
                        "folder with hydra.run.dir=PATH."
                    )
                raise UserError(
                    f"run folder {self.path} was made with {name}={old}, not {new}: choose another with "
                    "hydra.run.dir=PATH (hydra.sweep.dir=PATH for a sweep), or use the same settings."
                )

    def _same_path(self, name: str, there: object, now: object) -> bool:
        """Whether two values mean the same path: the old one from where it was typed, the new one from here."""
        if not (is_path(name) and isinstance(there, str) and isinstance(now, str)):
            return False
        return self.typed_in / there == Path.cwd() / now

    def _read(self, name: str) -> dict[str, Any] | None:
        path = self.path / name
        try:
            content: dict[str, Any] = read_json(path)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except ValueError as error:
            raise UserError(f"{path} is damaged ({error}): restore it, or choose another folder.") from None
        if not isinstance(content, dict):
            raise UserError(f"{path} is damaged (it holds no object): restore it, or choose another folder.")
        return content


def _machine() -> dict[str, str]:
    return {
        "torch": torch.__version__,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
    }


def _source() -> str:
    """Eight digits that stand for every line of the package's code."""
    root = Path(memcomp_lightning.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:8]


_LARGEST_SETTINGS = 2**20
"""Bytes of a settings.yaml that is read."""

_WORKERS = ("figure.workers", "worth.workers", "density.workers", "few_labels.workers")
_FREE_TO_CHANGE = (
    "logger.",
    "checkpoint_every",
    "copy_to",
    "copy_every",
    "data.source.data_dir",
    "data.source.download",
    *_WORKERS,
)
"""Settings that do not change what is computed."""


def _flat(node: Any, prefix: str = "") -> dict[str, Any]:
    """Settings by dotted name, unresolved."""
    if OmegaConf.is_config(node):
        node = OmegaConf.to_container(node, resolve=False)
    flat: dict[str, Any] = {}
    for key, value in node.items():
        flat.update(_flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value})
    return flat
