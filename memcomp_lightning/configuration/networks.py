"""The network of a run: from the settings of model and units, and from what the data are."""

import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from hydra.utils import get_class, get_method
from omegaconf import DictConfig, OmegaConf
from torch import nn

from memcomp_lightning import rng
from memcomp_lightning.configuration.errors import in_words
from memcomp_lightning.configuration.hydra_versions import instantiate
from memcomp_lightning.data import ImageData, PixelLayout
from memcomp_lightning.errors import UserError, require, require_count
from memcomp_lightning.models.units import Units
from memcomp_lightning.modules.trainers import PRECISIONS, precision_of
from memcomp_lightning.modules.weights import load_weights

if TYPE_CHECKING:
    from memcomp_lightning.configuration.rows import Data


class Shape(NamedTuple):
    """What a network must fit: all that it needs to know of the data.

    Attributes:
        units: Visible units.
        n_classes: Number of classes, 0 without labels.
        layout: Where the units lie in a picture; None where they lie in none.
    """

    units: Units
    n_classes: int
    layout: PixelLayout | None


def shape_of(data: "Data", config: DictConfig) -> Shape:
    """What the network must fit: tables say themselves which units they need."""
    if isinstance(data, ImageData):
        allowed = "a kind of units; columns are those of data=table, data=arrays and data=sequences"
        require("_target_" in config.units, "units", "columns", allowed)
        return Shape(units_of_settings(config, data.layout.n_visible), data.n_classes, data.layout)
    remedy = "Name the kinds of columns by data.columns={NAME: KIND}."
    named = "_target_" not in config.units
    require(named, "units", config.units.get("_target_"), "units=columns, which follow from the data", remedy)
    return Shape(data.units(), data.n_classes, data.layout)


def units_of_settings(config: DictConfig, n_sites: int) -> Units:
    """Visible units of the kind that ``units`` names."""
    return _units(config.units, "units", n_sites)


def network_of(config: DictConfig, shape: Shape) -> nn.Module:
    """The network of a run, with drawn weights or those of ``model.weights``."""
    units, layout = shape.units, shape.layout
    settings = OmegaConf.to_container(config.model, resolve=True)
    assert isinstance(settings, dict)
    weights = settings.pop("weights", None)
    settings.pop("output_init", None)
    partitions, first = config.data.partitions, config.data.first_partitions
    require_count("data.partitions", partitions)
    parameters = inspect.signature(get_class(settings["_target_"])).parameters
    arguments: dict[str, Any] = {
        "replicas": (min(partitions, first or partitions),) if partitions > 1 else (),
        "generator": rng.stream(config.seed, "weights"),
        **({"visible": units} if "visible" in parameters else {"n_visible": units.n}),
    }
    connectivity = settings.get("connectivity")
    if isinstance(connectivity, dict) and "_target_" in connectivity:
        of_picture = (
            {} if layout is None else {"height": layout.height, "width": layout.width, "pixels": layout.pixels}
        )
        known = inspect.signature(get_method(connectivity["_target_"])).parameters
        own = {name: value for name, value in of_picture.items() if name in known}
        allowed = "null for data that are no pictures, or data.picture=[HEIGHT, WIDTH]"
        require(bool(own) or "height" not in known, "model.connectivity", connectivity["_target_"], allowed)
        settings["connectivity"] = {**connectivity, **(own or {"n_visible": units.n_sites})}
    of_kind = settings.pop("hidden", None) is not None
    if of_kind and settings["n_hidden"] is not None:  # null follows from the connectivity
        require_count("model.n_hidden", settings["n_hidden"], minimum=0)
        arguments["hidden"] = _units(config.model.hidden, "model.hidden", settings.pop("n_hidden"))
    factory = instantiate(settings, _partial_=True, _convert_="all")
    if "n_classes" in parameters:
        arguments["n_classes"] = shape.n_classes
    try:
        network: nn.Module = factory(**arguments)
    except TypeError as error:
        raise UserError(f"model: {error}") from error
    network.to(PRECISIONS[precision_of(config.trainer.precision)])
    if weights is not None:
        require(isinstance(weights, str), "model.weights", weights, "the path of a weight file, or null")
        load_weights(network, Path(weights))
    return network


def _units(settings: DictConfig, name: str, n_sites: int) -> Units:
    """A layer of the kind that settings name, with so many units."""
    require(isinstance(settings, DictConfig), name, settings, "settings by name with a _target_")
    try:
        units = instantiate(settings)(n_sites)
    except TypeError as error:
        raise UserError(f"{name}: {in_words(error)}") from error
    require(isinstance(units, Units), name, type(units).__name__, "a kind of memcomp_lightning.models.units")
    return cast(Units, units)
