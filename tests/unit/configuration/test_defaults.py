"""A default stands in its class; configurations that say another one are listed here, with the reason."""

import inspect
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml

CONF = Path(__file__).parents[3] / "conf"
OTHERWISE = {
    ("callbacks/default", "every"): "fine-tuning has more passes than the pretraining of a layer",
    ("model/boltzmann", "n_hidden"): "in Python a list of pairs may say it",
    ("model/rbm", "n_hidden"): "in Python the hidden units may say it",
    ("units/categorical", "q"): "in Python each site may have its own",
    ("sampler/dwave_qpu", "beta"): "of a quantum annealer it is not known",
    ("sampler/dwave_qpu", "n_gauges"): "in Python it is one request, which a test of the chip wants",
}


def settings(node: Any) -> list[tuple[str, str, Any]]:
    """Target, name and value of every setting of a class of ours."""
    if isinstance(node, list):
        return [found for value in node for found in settings(value)]
    if not isinstance(node, dict):
        return []
    target = str(node.get("_target_", ""))
    own = [(target, name, value) for name, value in node.items() if target.startswith("memcomp_lightning.")]
    return own + [found for value in node.values() for found in settings(value)]


@pytest.mark.parametrize("path", sorted(CONF.rglob("*.yaml")), ids=lambda path: path.relative_to(CONF).as_posix())
def test_configurations_say_what_the_classes_do(path: Path) -> None:
    option = path.relative_to(CONF).with_suffix("").as_posix()
    if option.startswith(("control/", "preset/", "experiment/", "hparams/", "callbacks/diagnostics")):
        return  # what differs is what they are for
    for target, name, value in settings(yaml.safe_load(path.read_text())):
        module, _, made = target.rpartition(".")
        parameter = inspect.signature(getattr(import_module(module), made)).parameters.get(name)
        written = isinstance(value, dict | list) or "${" in str(value)
        if parameter is None or parameter.default is inspect.Parameter.empty or written:
            continue
        assert value == parameter.default or (option, name) in OTHERWISE, (option, name)
