"""A figure's command with all training on another device gives the numbers of the CPU."""

import sys
from pathlib import Path

import pytest
import stand_in
import torch
from hydra.core.global_hydra import GlobalHydra

from memcomp_lightning.cli import sweep, train
from memcomp_lightning.studies import Records, accuracy

CURVES = {
    "cd": "['sampler=cd']",
    "pcd": "['sampler=pcd', 'pretrain=centred']",
    "dmm_qubo": "['sampler=dmm_qubo']",
    "mode_assisted": "['sampler=mode_assisted_cd']",
    "joint": "['sampler=pcd', 'pretrain=joint']",
    "shuffled": "['sampler=cd', 'control=shuffled']",
    "batch_norm": "['model=baseline_bn_relu']",
}
FIGURE = [
    "experiment=figure4",
    "data=digits",
    "data.partitions=2",
    "figure.passes=[1]",
    "figure.seeds=[0]",
    "figure.iterations=[2]",
    "figure.workers=1",
    "figure/curves=none",
    "solver.max_steps=20",
    "solver.n_restarts=3",
    *(f"+figure.curves.{name}={{label: {name}, overrides: {settings}}}" for name, settings in CURVES.items()),
]


def test_the_same_command_gives_the_same_figure(
    device: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = {}
    for place in ("cpu", device):
        monkeypatch.setattr(sys, "argv", ["memcomp-train", *FIGURE, f"hydra.run.dir={place}"])
        monkeypatch.setattr(sweep.RememberSweepFolder, "folder", None)
        monkeypatch.setattr(accuracy, "device_of", lambda accelerator, place=place: torch.device(place))
        GlobalHydra.instance().clear()
        train.main()
        found[place] = {record.key: record.measures for record in Records(Path(place)).all}
    assert {key[1] for key in found["cpu"]} >= set(CURVES)
    if device == stand_in.NAME:
        assert stand_in.waits
        assert found[device] == found["cpu"]
    else:  # its generators draw other numbers
        assert found[device].keys() == found["cpu"].keys()
