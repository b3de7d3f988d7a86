"""A trained run as objects: its model, its network, and what its units stand for."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn

from memcomp_lightning.configuration.plans import Shape, classifier_of, network_of, units_of_settings
from memcomp_lightning.data.schema import ImageSchema, Schema, schema_of
from memcomp_lightning.errors import UserError, require, require_choice, require_count
from memcomp_lightning.models import DBM, DBN, EnergyModel
from memcomp_lightning.models.units import Units
from memcomp_lightning.modules.weights import check_fits, read_checkpoint
from memcomp_lightning.runs.folder import RunFolder


@dataclass(frozen=True, eq=False)
class Run:
    """What a training left, to be used.

    Attributes:
        path: The run folder, or the weight file.
        network: What was pretrained: an RBM, a Boltzmann machine, a DBN or DBM.
        classifier: The fine-tuned network, which maps values of the visible units to logits; None without one.
        schema: What the visible units stand for; None of a weight file without its run folder.
        pretrained: Whether ``network`` has trained weights; of a run without pretraining only the classifier has.
        settings: All settings of the run, as plain values; empty without the folder.
    """

    path: Path
    network: nn.Module
    classifier: nn.Module | None = None
    schema: Schema | None = None
    settings: Mapping[str, Any] | None = None
    pretrained: bool = True

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
                f"{self.path} was not pretrained: it has a classifier alone, and no model of the data. Train with "
                "pretrain.iterations=20, say."
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
                "folder, where schema.json does."
            )
        return self.schema


def load(
    path: str | Path,
    *,
    network: nn.Module | None = None,
    replica: int | None = None,
    trusted: Collection[str] = (),
) -> Run:
    """Read a run folder, or a weight file.

    No data are read, and no code but this package's runs: settings that name other code are refused.

    Args:
        path: A run folder of ``memcomp-train``, a file of its folder ``weights``, or a ``.safetensors`` file of
            ``memcomp-export``.
        network: Takes the weights of a file that lies by itself: an RBM, a DBN, any module. DBNs and RBMs of units
            in {0, 1} follow from the tensors: leave it out.
        replica: Which of several networks that were trained side by side (``data.partitions``), from 0.
        trusted: Packages of your own whose parts the settings may name: ``["your_package"]``.

    Raises:
        UserError, CheckpointError: There is no finished training; the message says what is needed.
    """
    path = Path(path)
    if path.is_dir():
        return _of_folder(path, replica, trusted)
    if path.suffix == ".safetensors":
        from memcomp_lightning.trained.export.safetensors import read  # which makes runs

        require(network is None, "network", type(network).__name__, "None: such a file says which it holds")
        require(replica in (None, 0), "replica", replica, "0: such a file holds one network")
        return read(path)
    beside = RunFolder(path.parent.parent)
    if network is None and beside.overrides is not None and path.parent.name == "weights":
        return _of_folder(beside.path, replica, trusted, file=path)
    state = read_checkpoint(path)
    if network is None:
        network = _network_of_tensors(state, path)
    check_fits(network, state, path)
    network.load_state_dict(state)
    return Run(path, network)


def _of_folder(path: Path, replica: int | None, trusted: Collection[str], *, file: Path | None = None) -> Run:
    folder, written = RunFolder(path), path / "settings.yaml"
    if folder.overrides is None or not written.is_file():
        raise UserError(f"{path} is no run folder of memcomp-train: it has no settings.yaml and overrides.json.")
    content = folder.schema
    if content is None:
        raise UserError(
            f"{path} has no schema.json: its training has not begun, or was made by an earlier version. Go on "
            f"with memcomp-train resume={path}"
        )
    schema, config = schema_of(content), cast(DictConfig, OmegaConf.load(written))
    for part in ("units", "model", "finetune"):
        # Resolved, and for good: what an interpolation stands for is checked, too.
        config[part] = OmegaConf.to_container(config[part], resolve=True)
        _check_targets(OmegaConf.to_container(config[part]), part, path, trusted)
    n_replicas = _n_replicas(config)
    if n_replicas is None:
        require(replica in (None, 0), "replica", replica, "0: this run has one network")
    elif replica is not None:
        require_count("replica", replica, 0)
        require(replica < n_replicas, "replica", replica, f"an integer from 0 to {n_replicas - 1}")
    config.data.partitions, config.data.first_partitions, config.model.weights = 1, None, None
    files = {name: folder.weights(name) for name in ("pretrain", "finetune")}
    if file is not None:
        require_choice("weight file", file.stem, tuple(files))
    if file is not None and file.stem == "pretrain":
        files = {"pretrain": file}
    there = {name: where for name, where in files.items() if where.is_file()}
    if not there:
        raise UserError(f"{path} has no trained weights yet: go on with memcomp-train resume={path}")
    pairs, edges = read_checkpoint(next(iter(there.values()))).get("pairs"), config.model.get("connectivity")
    if isinstance(pairs, Tensor) and isinstance(edges, DictConfig):
        # Its file may be elsewhere, and pictures are not known here. It joins sites, pairs are of their entries.
        config.model.connectivity = _units_of(config, schema).site_of()[pairs].unique(dim=0).tolist()
    network, classifier = _network(config, schema), None
    if "pretrain" in there:
        _take(network, there["pretrain"], n_replicas, replica)
    if "finetune" in there:
        # On a network of its own: the energy model keeps the weights of its pretraining.
        classifier = classifier_of(config, _network(config, schema), schema.n_classes).network.eval()
        _take(classifier, there["finetune"], n_replicas, replica)
    settings = cast(dict[str, Any], OmegaConf.to_container(config))
    return Run(path, network.eval(), classifier, schema, settings, "pretrain" in there)


_OWN = ("memcomp_lightning.", "torch.optim.")


def _check_targets(node: Any, name: str, path: Path, trusted: Collection[str]) -> None:
    """Refuse settings that name code of other packages: a folder may come from a stranger."""
    if isinstance(node, dict):
        target = node.get("_target_")
        allowed = (*_OWN, *(f"{package}." for package in trusted))
        if target is not None and not (str(target).startswith(allowed) and _is_of(str(target), allowed)):
            package = str(target).partition(".")[0]
            raise UserError(
                f"{path}: {name} is {target}, which is code of another package. If you trust it, in Python type "
                f"load({str(path)!r}, trusted=[{package!r}])."
            )
    for key, value in (
        node.items() if isinstance(node, dict) else enumerate(node if isinstance(node, list) else ())
    ):
        _check_targets(value, f"{name}.{key}", path, trusted)


def _is_of(target: str, packages: tuple[str, ...]) -> bool:
    """Whether a name is that of a class or function which one of the packages defines, not of what it imports."""
    try:
        found = resolve_name(target)
    except (ImportError, AttributeError, ValueError):
        return False
    return f"{getattr(found, '__module__', '')}.".startswith(packages)


def _network(config: DictConfig, schema: Schema) -> nn.Module:
    layout = schema.layout if isinstance(schema, ImageSchema) else getattr(schema, "layout", None)
    return network_of(config, Shape(_units_of(config, schema), schema.n_classes, layout))


def _units_of(config: DictConfig, schema: Schema) -> Units:
    return schema.units() or units_of_settings(config, schema.n_sites)


def _n_replicas(config: DictConfig) -> int | None:
    n = config.data.partitions
    return min(n, config.data.first_partitions or n) if n > 1 else None


def _take(module: nn.Module, path: Path, n_replicas: int | None, replica: int | None) -> None:
    """Load a weight file, of several replicas that of one."""
    state = read_checkpoint(path)
    if n_replicas is not None:
        own, at = module.state_dict(), replica or 0
        state = {
            name: x[at] if name in own and x.shape == (n_replicas, *own[name].shape) else x
            for name, x in state.items()
        }
    check_fits(module, state, path)
    module.load_state_dict(state)


def _network_of_tensors(state: Mapping[str, Any], path: Path) -> nn.Module:
    """An RBM or DBN of units in {0, 1}, as its tensors say."""
    from memcomp_lightning.models import RBM

    weights = {name: x for name, x in state.items() if isinstance(x, Tensor) and name.endswith("weight")}
    if set(state) == {"weight", "b", "c"} and state["weight"].ndim == 2:
        n_hidden, n_visible = state["weight"].shape
        return RBM(n_visible, n_hidden)
    names = {f"rbms.{layer}.{part}" for layer in range(len(weights)) for part in ("weight", "b", "c")}
    if set(state) == names and all(x.ndim == 2 for x in weights.values()):
        sizes = [state[f"rbms.{layer}.weight"].shape for layer in range(len(weights))]
        return DBN(sizes[0][1], [n_hidden for n_hidden, _ in sizes])
    held = ", ".join(sorted(state)[:6])
    raise UserError(
        f"{path} lies by itself and holds {held}: the kinds of its units do not follow from them. Name its run "
        "folder, or in Python give the network: load(PATH, network=RBM(...))."
    )
