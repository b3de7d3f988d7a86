"""A callback stands in the module of its key in the configuration."""

from pathlib import Path

import pytest
import yaml

import memcomp_lightning.callbacks

CONF = Path(__file__).parents[3] / "conf" / "callbacks"
NAMED = {
    (key, settings["_target_"])
    for path in CONF.glob("*.yaml")
    for stage in ("pretrain", "finetune")
    for key, settings in yaml.safe_load(path.read_text()).get(stage, {}).items()
    if "_target_" in settings
}


@pytest.mark.parametrize(("key", "target"), sorted(NAMED))
def test_a_callback_stands_in_the_module_of_its_key(key: str, target: str) -> None:
    package, _, name = target.rpartition(".")
    assert package == "memcomp_lightning.callbacks"
    assert getattr(memcomp_lightning.callbacks, name).__module__ == f"{package}.{key}"
