"""What experiments/accelerator makes of each piece of work, of work that takes too long, and of a second start."""

import csv
import dataclasses
import importlib.util
import math
import sys
import time
from pathlib import Path

import pytest
import torch

sys.path.append(str(Path(__file__).parents[3] / "experiments" / "accelerator"))
import waits
from work import QUICK, WORKS, Work

TINY = dataclasses.replace(
    QUICK,
    visible=8,
    hidden=6,
    wide=10,
    rows=100,
    few_rows=100,
    chains=10,
    betas=3,
    problems=2,
    steps=2,
    slow_steps=1,
)


@pytest.fixture(scope="module")
def accelerator():
    spec = importlib.util.spec_from_file_location("accelerator_run", Path(waits.__file__).with_name("run.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def measured(accelerator, folder, names=tuple(WORKS), budget=20.0, seconds=300.0):
    until = time.perf_counter() + seconds
    settings = {"size": TINY, "small": TINY, "budget": budget, "until": until, "label": "tiny"}
    return accelerator.run(folder, "cpu", list(names), **settings)


def test_everything_runs_and_is_reported(accelerator, tmp_path, capsys):
    threads = torch.get_num_threads()
    found = measured(accelerator, tmp_path)
    assert torch.get_num_threads() == threads
    rows = {row["row"]: row for row in csv.DictReader((tmp_path / "table.csv").read_text().splitlines())}
    assert rows.keys() == {name for name, work in WORKS.items() if work.beside is None}
    for name, row in rows.items():
        assert row["device"] == "cpu"
        assert row["note"] == ""
        assert row["repetitions"] == str(accelerator.ENOUGH)
        assert float(row["s a unit"]) > 0
        assert math.isclose(float(row["s a whole"]), WORKS[name].whole[0] * float(row["s a unit"]))
    page = (tmp_path / "table.md").read_text()
    assert "no measurements" in page
    assert "counted/cd_host_draws, 1 x update of 100 rows: none" in page
    assert "reference.py" in page
    assert found["counted/dmm_large"]["units"] == TINY.steps
    (tmp_path / "table.md").unlink()
    capsys.readouterr()
    assert measured(accelerator, tmp_path) == found
    assert capsys.readouterr().out == "", "measured once more"
    with pytest.raises(SystemExit, match="give another --out"):
        accelerator.run(tmp_path, "cpu", [], size=TINY, budget=1, until=0, label="full")


def slow(device, size):
    def piece():
        end = time.perf_counter() + (0.05 if slow.calls == 0 else 60)
        slow.calls += 1
        while time.perf_counter() < end:
            pass
        return 1

    return piece


def broken(device, size):
    raise RuntimeError("out of memory\nand more")


def test_what_takes_too_long_or_fails_leaves_the_others_alone(accelerator, tmp_path, monkeypatch):
    slow.calls, which = 0, {"what": "", "unit": "piece", "whole": (1, "piece")}
    monkeypatch.setitem(WORKS, "slow_kernel", Work(start=slow, **which))
    monkeypatch.setitem(WORKS, "broken_kernel", Work(start=broken, **which))
    found = measured(accelerator, tmp_path, ["slow_kernel", "broken_kernel", "cd"], budget=0.5)
    assert found["cpu/slow_kernel"]["note"] == "stopped after 2 s"
    assert found["cpu/slow_kernel"]["first_s"] == pytest.approx(0.05, rel=2)
    assert found["cpu/broken_kernel"] == {"seconds": [], "first_s": None, "note": "RuntimeError: out of memory"}
    assert found["cpu/cd"]["seconds"]


def test_nothing_begins_after_the_time_is_up_and_the_next_start_goes_on(accelerator, tmp_path, capsys):
    assert measured(accelerator, tmp_path, ["cd"], seconds=-1) == {}
    assert "cpu/cd: not begun, the time is up" in capsys.readouterr().out
    assert measured(accelerator, tmp_path, ["cd"]).keys() == {"counted/cd", "cpu/cd"}


def test_the_device_that_stands_in_leaves_torch_as_it_was():
    before = torch.Generator
    with waits.usable():
        assert torch.Generator is not before
        assert torch.full((2,), 1.0, device=waits.STAND_IN).device.type == waits.STAND_IN
    assert torch.Generator is before


def test_a_device_that_is_not_there_is_an_error(accelerator, tmp_path, monkeypatch, capsys):
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    monkeypatch.setattr(sys, "argv", ["run.py", "--out", str(tmp_path), "--device", "cuda"])
    with pytest.raises(SystemExit):
        accelerator.main()
    assert "no CUDA device" in capsys.readouterr().err
