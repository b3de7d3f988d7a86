"""Run folders whose settings or schema are damaged are refused in a line."""

import json
import shutil
import subprocess
import sys

import pytest

from memcomp_lightning import load
from memcomp_lightning.errors import UserError


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    settings = ["data=bars_and_stripes", "model=one_layer", "model.hidden_sizes=[2]", "logger=none"]
    settings += ["pretrain.iterations=1", "finetune.iterations=0", f"hydra.run.dir={folder}/run"]
    command = [sys.executable, "-m", "memcomp_lightning.cli.train", *settings]
    subprocess.run(command, check=True, capture_output=True, cwd=folder)
    return folder / "run"


@pytest.mark.parametrize("part", ["units", "model", "finetune", "data", "hidden_sizes", "_target_"])
def test_settings_that_are_missing_or_spelt_otherwise(tmp_path, whole, part):
    run = shutil.copytree(whole, tmp_path / "run")
    text = (run / "settings.yaml").read_text()
    assert f"{part}:" in text
    (run / "settings.yaml").write_text(text.replace(f"{part}:", f"x{part}:"))
    with pytest.raises(UserError) as caught:
        load(run)
    assert "\n" not in str(caught.value)
    assert part in str(caught.value) or str(caught.value).startswith(("units:", "model:"))


@pytest.mark.parametrize("change", [{"height": "x"}, {"pixels": [0.5]}, {"n_classes": None}, {"data": {}}])
def test_schemas_of_other_values(tmp_path, whole, change):
    run = shutil.copytree(whole, tmp_path / "run")
    content = json.loads((run / "schema.json").read_text())
    (run / "schema.json").write_text(json.dumps(content | change))
    with pytest.raises((UserError, ValueError)) as caught:
        load(run)
    assert "\n" not in str(caught.value)
