"""A trained run as objects: its model, its network, and what its units stand for."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn

from memcomp_lightning.configuration.errors import CONFIGURATION_ERRORS, explain
from memcomp_lightning.configuration.networks import Shape, network_of, units_of_settings
from memcomp_lightning.configuration.plans import classifier_of
from memcomp_lightning.data.schema import ImageSchema, Schema, schema_of
from memcomp_lightning.errors import Told, UserError, require
from memcomp_lightning.models import DBM, DBN, EnergyModel
from memcomp_lightning.models.units import Units
from memcomp_lightning.runs.addresses import is_address, read_at
from memcomp_lightning.runs.folder import RunFolder
from memcomp_lightning.runs.trust import check_targets, forget_lost_initialisers, resolved
from memcomp_lightning.trained.alone import network_of as network_alone
from memcomp_lightning.trained.alone import one_of, replica_of, schema_in, taken, tensors_of, warn


@dataclass(frozen=True, eq=False)
class Run:
    """What a training left, to be used.

    Attributes:
        path: The run folder, or the file.
        network: What was pretrained: an RBM, a Boltzmann machine, a DBN or DBM.
        classifier: The fine-tuned network, which maps values of the visible units to logits; None without one.
        schema: What the visible units stand for; None of a weight file without its run folder.
        pretrained: Whether ``network`` has trained weights; of a run without pretraining only the classifier has.
        settings: All settings of the run, as plain values; empty without the folder.
        replica: Which of several networks that were trained side by side.
        trusted: Packages of its user's own, whose parts its settings may name.
    """

    path: Path
    network: nn.Module
    classifier: nn.Module | None = None
    schema: Schema | None = None
    settings: Mapping[str, Any] | None = None
    pretrained: bool = True
    replica: int = 0
    trusted: Collection[str] = ()

    @property
    def model(self) -> EnergyModel:
        """The energy model of the data.

        That of a DBN of one layer is its RBM; of one whose layers were trained jointly, the deep Boltzmann machine
        with its weights.

        Raises:
            UserError: A DBN of several layers that were trained one after the other, or no energy model.
        """
        self.require_pretrained()
        network = self.network
        if isinstance(network, DBN) and len(network) == 1:
            return cast(EnergyModel, network[0])
        if isinstance(network, DBN) and self.trained_jointly:
            return cast(EnergyModel, DBM.from_dbn(network))
        if isinstance(network, DBN):
            raise UserError(
                f"{self.path} is a deep belief network of {len(network)} layers, which has no energy of its own: "
                "train with model=one_layer, model=rbm or pretrain=joint for this."
            )
        if not hasattr(network, "energy"):
            raise UserError(f"{self.path} is a {type(network).__name__}, which is no energy model.")
        return cast(EnergyModel, network)

    def require_pretrained(self) -> None:
        """Raise a UserError unless the network has trained weights."""
        if not self.pretrained:
            raise UserError(
                f"{self.path} was not pretrained: it has no energy model of the data. "
                + ("Name its run folder." if self.path.is_file() else "Train with pretrain.iterations=20, say.")
            )

    @property
    def trained_jointly(self) -> bool:
        """Whether the layers of a DBN were pretrained at once, as one Boltzmann machine."""
        stage = (self.settings or {}).get("pretrain", {}).get("stage") or {}
        return str(stage.get("_target_", "")).endswith(".Joint")

    @property
    def needed_schema(self) -> Schema:
        """The schema.

        Raises:
            UserError: There is none.
        """
        if self.schema is None:
            raise UserError(
                f"{self.path} is a weight file alone, which does not say what its units stand for: name the run "
                "folder, or give schema=FILE, the schema.json of that folder."
            )
        return self.schema


def load(
    path: str | Path,
    *,
    network: nn.Module | None = None,
    schema: Schema | str | Path | None = None,
    replica: int | None = None,
    trusted: Collection[str] = (),
) -> Run:
    """Read a run folder, a weight file or a checkpoint.

    No data are read, and no code runs but that of models: settings that name anything else are refused.

    A :class:`~memcomp_lightning.trained.alone.LoadWarning` says what was assumed: which of several networks was
    taken, units that a file does not name, a run that has not finished.

    Args:
        path: A run folder of ``memcomp-train``, the address that it was copied to (``s3://bucket/run``), a file of
            its folders ``weights`` and ``checkpoints``, such a file moved elsewhere, or a ``.safetensors`` file of
            ``memcomp-export``.
        network: Takes the weights of a file that lies by itself: an RBM, a DBN, any module. DBNs, RBMs and
            classifiers of hidden units in {0, 1} follow from the tensors: leave it out.
        schema: What the visible units of a file that lies by itself stand for: a ``schema.json`` of the run
            folder, or a schema. Without it there is a model, but no columns and words.
        replica: Which of several networks that were trained side by side (``data.partitions``), from 0.
        trusted: Packages of your own whose parts the settings may name: ``["your_package"]``.

    Raises:
        UserError, CheckpointError: There is no finished training; the message says what is needed.
    """
    if is_address(str(path)):
        _require_no_schema(schema, "a run folder has its own")
        with read_at(str(path)) as folder:
            return _of_folder(folder, replica, trusted)
    path = Path(path)
    if path.is_dir():
        _require_no_schema(schema, "a run folder has its own")
        return _of_folder(path, replica, trusted)
    if path.suffix == ".safetensors":
        from memcomp_lightning.trained.export.safetensors import read  # which makes runs

        require(network is None, "network", type(network).__name__, "None: such a file says which it holds")
        require(replica in (None, 0), "replica", replica, "0: such a file holds one network")
        _require_no_schema(schema, "such a file has its own")
        return read(path)
    if not path.is_file():
        raise UserError(f"{path}: there is no such run folder, weight file or checkpoint.")
    if network is None and schema is None and (place := _place_of(path)) is not None:
        return _of_folder(place.folder, replica, trusted, place)
    return _of_file(path, network, schema_in(Path(schema)) if isinstance(schema, str | Path) else schema, replica)


def _require_no_schema(schema: object, why: str) -> None:
    require(schema is None, "schema", str(schema), f"none: {why}")


class _Place(NamedTuple):
    """Where a file lies in a run folder, and the stage that it is of."""

    folder: Path
    file: Path
    stage: str


def _place_of(path: Path) -> _Place | None:
    """The place of a weight file or a checkpoint in its run folder; None of one that lies elsewhere."""
    for folder, kind, stage in (
        (path.parent.parent, path.parent.name, path.stem),
        (path.parent.parent.parent, path.parent.parent.name, path.parent.name),
    ):
        fits = kind == ("weights" if path.suffix == ".pt" else "checkpoints")
        if fits and stage in ("pretrain", "finetune") and RunFolder(folder).schema is not None:
            return _Place(folder, path, stage)
    return None


def _of_file(path: Path, network: nn.Module | None, schema: Schema | None, replica: int | None) -> Run:
    """A file that lies by itself."""
    state = tensors_of(path)
    made = network_alone(state, path, schema) if network is None else network
    taken(made, one_of(state, made.state_dict(), replica, path), path)
    if network is None and isinstance(made, nn.Sequential):
        return Run(path, made[0], made, schema, {}, pretrained=False)
    return Run(path, made, None, schema, {})


def _of_folder(path: Path, replica: int | None, trusted: Collection[str], place: _Place | None = None) -> Run:
    try:
        return _read_folder(path, replica, trusted, place)
    except Told:
        raise
    except (*CONFIGURATION_ERRORS, LookupError, AttributeError, RuntimeError) as error:
        raise UserError(
            f"{path}: its settings.yaml or schema.json is damaged, or another version wrote it "
            f"({type(error).__name__}: {' '.join(explain(error).split())[:200]}). Restore it."
        ) from error


def _read_folder(path: Path, replica: int | None, trusted: Collection[str], place: _Place | None) -> Run:
    folder = RunFolder(path)
    config = folder.settings
    if folder.overrides is None or config is None:
        raise UserError(f"{path} is no run folder of memcomp-train: it has no settings.yaml and overrides.json.")
    content = folder.schema
    if content is None:
        left = [folder.weights(name) for name in ("finetune", "pretrain") if folder.weights(name).is_file()]
        if left:
            raise UserError(
                f"{path} has no schema.json, as runs of versions before 0.3.0 have none (this one is of version "
                f"{folder.version}): name its weights in place of the folder, {' or '.join(map(str, left))}"
            )
        raise UserError(
            f"{path} has no schema.json: its training has not begun. Go on with memcomp-train resume={path}"
        )
    schema = schema_of(content)
    for part in ("units", "model", "finetune"):
        # Resolved, and for good: what an interpolation stands for is checked, too.
        config[part] = resolved(config[part], part, path)
        if part == "model":
            forget_lost_initialisers(config.model)
        check_targets(OmegaConf.to_container(config[part]), part, path, trusted)
    n_replicas = _n_replicas(config)
    if n_replicas is None:
        require(replica in (None, 0), "replica", replica, "0: this run has one network")
    else:
        replica = replica_of(replica, n_replicas, path)
    config.data.partitions, config.data.first_partitions, config.model.weights = 1, None, None
    files = {name: folder.weights(name) for name in ("pretrain", "finetune")}
    if place is not None:
        files = ({} if place.stage == "pretrain" else files) | {place.stage: place.file}
    states = {name: tensors_of(where) for name, where in files.items() if where.is_file() or place is not None}
    if not states and not folder.weights("updown").is_file():
        begun = [folder.checkpoint(name) for name in files if folder.checkpoint(name).is_file()]
        as_it_is = f", or name its checkpoint as it is, {begun[0]}" if begun else ""
        raise UserError(f"{path} has no trained weights yet: go on with memcomp-train resume={path}{as_it_is}")
    if place is None and folder.result is None:
        warn(
            f"{path} has not finished: it has {' and '.join(states)} alone. Go on with memcomp-train resume={path}"
        )
    pairs, edges = next(iter(states.values()), {}).get("pairs"), config.model.get("connectivity")
    if isinstance(pairs, Tensor) and isinstance(edges, DictConfig):
        # Its file may be elsewhere, and pictures are not known here. It joins sites, pairs are of their entries.
        visible = _units_of(config, schema)
        hidden = torch.arange(max(0, int(pairs.max()) + 1 - visible.n), device="cpu")  # of one entry each
        sites = torch.cat((visible.site_of(), visible.n_sites + hidden))
        config.model.connectivity = sites[pairs].unique(dim=0).tolist()
        if config.model.n_hidden is None:
            config.model.n_hidden = len(hidden)
    network, classifier = _network(config, schema), None
    if "pretrain" in states:
        _take(network, states["pretrain"], files["pretrain"], replica)
    if "finetune" in states:
        # On a network of its own: the energy model keeps the weights of its pretraining.
        classifier = classifier_of(config, _network(config, schema), schema.n_classes).network.eval()
        _take(classifier, states["finetune"], files["finetune"], replica)
    settings = cast(dict[str, Any], OmegaConf.to_container(config))
    return Run(path, network.eval(), classifier, schema, settings, "pretrain" in states, replica or 0, trusted)


def _network(config: DictConfig, schema: Schema) -> nn.Module:
    layout = schema.layout if isinstance(schema, ImageSchema) else getattr(schema, "layout", None)
    return network_of(config, Shape(_units_of(config, schema), schema.n_classes, layout))


def _units_of(config: DictConfig, schema: Schema) -> Units:
    return schema.units() or units_of_settings(config, schema.n_sites)


def _n_replicas(config: DictConfig) -> int | None:
    n = config.data.partitions
    return min(n, config.data.first_partitions or n) if n > 1 else None


def _take(module: nn.Module, state: dict[str, Tensor], path: Path, replica: int | None) -> None:
    """Load tensors, of several replicas those of one."""
    taken(module, one_of(state, module.state_dict(), replica, path), path)
