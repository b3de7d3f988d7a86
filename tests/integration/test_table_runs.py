"""Runs of ``memcomp-train data=table``: from a file to a run that is loaded, resumed and used."""

import json
import shutil
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy
import pytest
import torch
from omegaconf import OmegaConf
from running import QUIET, Outcome

import memcomp_lightning
from memcomp_lightning.errors import UserError
from memcomp_lightning.models import RBM
from memcomp_lightning.trained import LoadWarning
from memcomp_lightning.trained.run import check_targets

pytest.importorskip("pyarrow")

TABLE = "id,age,sex,colour,species\n" + "".join(
    f"{i},{20 + 7 * (i % 5) + i % 3},{'fm'[i % 2]},{['red', 'green', '', 'blue'][i % 4]},{['cat', 'dog'][i % 2]}\n"
    for i in range(120)
)
QUICK = [*QUIET, "model.hidden_sizes=[4]", "pretrain.iterations=2", "finetune.iterations=2"]


Command = Callable[..., Outcome]


@pytest.fixture
def command(run_command: Callable[..., Outcome], monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run a command in this process, in a folder."""

    def run(name: str, *arguments: str, folder: Path) -> Outcome:
        monkeypatch.chdir(folder)
        return run_command(f"memcomp-{name}", import_module(f"memcomp_lightning.cli.{name}").main, arguments)

    return run


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table."""
    folder = tmp_path_factory.mktemp("tables")
    (folder / "people.csv").write_text(TABLE)
    return folder


@pytest.fixture
def folder(made: Path, command: Command) -> Path:
    """The table, and two runs of it: without its gaps and with labels, with gaps and without labels."""
    for run, columns in (("labelled", "{label: species, colour: ignore}"), ("gaps", "{species: ignore}")):
        if not (made / run).exists():
            settings = ["data=table", "data.path=people.csv", f"data.columns={columns}", *QUICK]
            found = command("train", *settings, f"hydra.run.dir={run}", folder=made)
            assert found.status == 0, found.err
            (made / f"{run}.txt").write_text(found.out)
    return made


def test_the_columns_are_shown(folder: Path) -> None:
    shown = (folder / "labelled.txt").read_text()
    assert "108 rows to train on, 12 test rows" in shown
    for line in ("age real", "sex binary f, m", "species label", "id ignored it counts the rows"):
        assert line in " ".join(shown.split())
    assert "test accuracy" in shown
    assert "accuracy" not in (folder / "gaps.txt").read_text()


def test_a_run_is_loaded(folder: Path) -> None:
    run = memcomp_lightning.load(folder / "labelled")
    assert isinstance(run.model, RBM)
    assert run.model.n_hidden == 4
    assert run.classifier is not None
    assert run.schema is not None
    assert run.schema.entry_names == ["sex", "age"]
    assert run.schema.class_names == ["cat", "dog"]
    assert run.classifier(torch.zeros(3, 2)).shape == (3, 2)
    alone = memcomp_lightning.load(folder / "labelled/weights/pretrain.pt")
    assert torch.equal(alone.model.b, run.model.b)
    assert alone.classifier is None
    first = run.classifier[0][0]  # type: ignore[index]
    assert not torch.equal(first.weight, run.model.weight), (
        "fine-tuning has changed the weights of its own network"
    )


def test_weights_by_themselves(folder: Path, tmp_path: Path) -> None:
    weights = folder / "gaps/weights/pretrain.pt"
    alone = tmp_path / "alone.pt"
    alone.write_bytes(weights.read_bytes())
    with pytest.raises(UserError, match="the kinds of its units do not follow from them"):
        memcomp_lightning.load(alone)
    with pytest.raises(UserError, match="is no run folder of memcomp-train"):
        memcomp_lightning.load(tmp_path)
    bits = RBM(5, 3)
    torch.save(bits.state_dict(), alone)
    with pytest.warns(LoadWarning, match="its visible and hidden units are taken for bits"):
        found = memcomp_lightning.load(alone)
    assert torch.equal(found.model.c, bits.c)
    with pytest.raises(UserError, match="a weight file alone, which does not say what its units stand for"):
        _ = found.needed_schema


def test_code_of_others_does_not_run(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(folder / "labelled", copy)
    settings = copy / "settings.yaml"
    settings.write_text(settings.read_text().replace("memcomp_lightning.models.Normal", "os.system"))
    with pytest.raises(
        UserError, match=r"model\.\w+_init is os\.system, which is no part of a model of this package"
    ):
        memcomp_lightning.load(copy)
    with pytest.raises(UserError, match="which is no part of a model of this package"):
        memcomp_lightning.load(copy / "weights/pretrain.pt")


@pytest.mark.parametrize(
    "target", ["memcomp_lightning.runs.folder.os.getcwd", "nothing.at.all", "torch.optim.sys.exit"]
)
def test_imports_of_ours_are_code_of_others(folder: Path, tmp_path: Path, target: str) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(folder / "labelled", copy)
    settings = copy / "settings.yaml"
    settings.write_text(settings.read_text().replace("memcomp_lightning.models.Normal", target))
    with pytest.raises(UserError, match="which is no part of a model of this package"):
        memcomp_lightning.load(copy)


def test_functions_of_ours_do_not_run(folder: Path, tmp_path: Path) -> None:
    """As one that writes a file: parts of models are classes, whose making does nothing."""
    copy, victim = tmp_path / "copy", tmp_path / "victim.txt"
    shutil.copytree(folder / "labelled", copy)
    victim.write_text("mine")
    settings = copy / "settings.yaml"
    begin, _, rest = settings.read_text().partition("  weight_init:\n")
    call = f"{{_target_: memcomp_lightning.cli.products.existing, path: {victim}}}"
    nested = f"{{_target_: memcomp_lightning.files.write_text, path: {call}, text: theirs}}"
    settings.write_text(f"{begin}  weight_init: {nested}\n" + rest[rest.index("\n  output_init:") + 1 :])
    with pytest.raises(UserError, match=r"files\.write_text, which is no part of a model of this package"):
        memcomp_lightning.load(copy)
    assert victim.read_text() == "mine"


@pytest.mark.parametrize("group", ["model", "units", "finetune"])
def test_every_option_is_a_part_of_a_model(group: str) -> None:
    """What our own settings name is allowed where runs are loaded."""
    for path in sorted((Path(memcomp_lightning.__file__).parent / "conf" / group).glob("*.yaml")):
        check_targets(OmegaConf.to_container(OmegaConf.load(path), resolve=False), group, path)


def test_runs_of_earlier_versions(folder: Path, tmp_path: Path) -> None:
    """How weights began is not needed any more; that a part is lost is said."""
    copy = tmp_path / "copy"
    shutil.copytree(folder / "labelled", copy)
    settings = copy / "settings.yaml"
    text = settings.read_text()
    settings.write_text(text.replace("memcomp_lightning.models.Normal", "memcomp_lightning.models.Gaussian"))
    then, now = memcomp_lightning.load(copy), memcomp_lightning.load(folder / "labelled")
    assert torch.equal(then.model.b, now.model.b)
    settings.write_text(text.replace("memcomp_lightning.models.DBN", "memcomp_lightning.models.Stack"))
    with pytest.raises(UserError, match=r"Stack, which this version, .*, does not have"):
        memcomp_lightning.load(copy)


def test_what_an_interpolation_stands_for_is_checked(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(folder / "labelled", copy)
    settings = copy / "settings.yaml"
    text = settings.read_text().replace("model:\n", "model:\n  output_init: ${hidden_away}\n", 1)
    before, _, after = text.partition("  output_init:\n")
    after = after.partition("\n  weights:")[2]
    settings.write_text(before + "  weights:" + after + "\nhidden_away:\n  _target_: os.getcwd\n")
    with pytest.raises(
        UserError, match=r"model\.output_init is os\.getcwd, which is no part of a model of this package"
    ):
        memcomp_lightning.load(copy)


def test_a_run_without_pretraining_has_no_model(folder: Path, command: Command) -> None:
    settings = ["data=table", "data.path=people.csv", "data.columns={label: species, colour: ignore}", *QUICK]
    found = command("train", *settings, "pretrain.iterations=0", "hydra.run.dir=alone", folder=folder)
    assert found.status == 0, found.err
    run = memcomp_lightning.load(folder / "alone")
    assert run.classifier is not None
    with pytest.raises(UserError, match="was not pretrained: it has no energy model"):
        _ = run.model
    found = command("transform", "alone", "people.csv", "output=none.csv", folder=folder)
    assert "was not pretrained" in found.err


def test_a_baseline_has_classes(folder: Path, command: Command) -> None:
    settings = ["data=table", "data.path=people.csv", "data.columns={label: species, colour: ignore}", *QUICK]
    found = command("train", *settings, "control=bn_relu", "hydra.run.dir=baseline", folder=folder)
    assert found.status == 0, found.err
    found = command("score", "baseline", "people.csv", "output=classes.csv", folder=folder)
    assert found.status == 0, found.err
    assert (folder / "classes.csv").read_text().startswith("row,id,colour,species,p(cat),p(dog),class\n")
    assert "no likelihoods: baseline was not pretrained" in found.out


def test_rows_that_complete_a_file_keep_its_other_columns(folder: Path, command: Command) -> None:
    (folder / "some.csv").write_text("id,sex,age\n7,f,\n8,m,30\n")
    for n, ids in ((1, ["7", "8"]), (2, ["7", "7", "8", "8"])):
        found = command("sample", "gaps", "given=some.csv", f"n={n}", f"output=drawn{n}.csv", folder=folder)
        assert found.status == 0, found.err
        lines = (folder / f"drawn{n}.csv").read_text().splitlines()
        assert lines[0].startswith("id,")
        assert [line.partition(",")[0] for line in lines[1:]] == ids
        assert all(",30," in f"{line}," for line in lines[1:] if line.startswith("8"))


def test_a_run_of_pictures_of_spins_is_loaded(folder: Path, command: Command) -> None:
    numpy.save(folder / "spins.npy", numpy.random.default_rng(0).choice([-1, 1], (60, 9)))
    settings = ["data=arrays", "data.path=spins.npy", "data.picture=[3,3]", "model=ising", "sampler=cd", *QUIET]
    found = command("train", *settings, "pretrain.iterations=1", "hydra.run.dir=spins", folder=folder)
    assert found.status == 0, found.err
    assert len(memcomp_lightning.load(folder / "spins").network.pairs) == 12  # type: ignore[arg-type]


def test_features(folder: Path, command: Command) -> None:
    found = command("transform", "labelled", "people.csv", "output=features.csv", folder=folder)
    assert found.status == 0, found.err
    lines = (folder / "features.csv").read_text().splitlines()
    assert lines[0] == "id,colour,species,h1,h2,h3,h4"
    assert lines[2].startswith("1,green,dog,0.")
    assert len(lines) == 121
    again = command("transform", "labelled", "people.csv", "output=features.csv", folder=folder)
    assert again.status == 2
    assert "the file is there already" in again.err
    gaps = command("transform", "gaps", "people.csv", "output=none.csv", folder=folder)
    assert "row 3, column 'colour' is empty: fill it first" in gaps.err
    assert not (folder / "none.csv").exists()


def test_a_table_that_has_changed_is_not_mixed_in(folder: Path, command: Command) -> None:
    run = folder / "gaps"
    (run / "result.json").rename(run / "kept.json")
    before = (folder / "people.csv").read_text()
    (folder / "people.csv").write_text(before + "121,99,m,violet,cat\n")
    try:
        found = command("train", "resume=gaps", folder=folder)
    finally:
        (folder / "people.csv").write_text(before)
        (run / "kept.json").rename(run / "result.json")
    assert found.status == 2
    assert "have changed since its training began" in found.err


def test_paths_are_meant_from_where_they_were_typed(folder: Path, command: Command, tmp_path: Path) -> None:
    kept = json.loads((folder / "labelled/overrides.json").read_text())
    assert kept["folder"] == str(folder)
    found = command("train", f"resume={folder / 'labelled'}", folder=tmp_path)
    assert found.status == 0, found.err


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["data=table"], "data.path names no file: type data.path=FILE"),
        (["data=table", "data.path=none.csv"], "none.csv: there is no such file"),
        (["data=table", "data.path=people.csv", "units=spin"], "units = "),
        (["data=table", "data.path=people.csv", "data.paht=x"], "data.path"),
        (
            ["data=table", "data.path=halves.csv", "data.columns={label: x}", "seed=1"],
            "train: halves.csv, column 'x', row 1",
        ),
        (["data=digits", "units=columns"], "units = 'columns' is not allowed"),
    ],
)
def test_mistakes(folder: Path, command: Command, settings: list[str], message: str) -> None:
    (folder / "halves.csv").write_text("x,y\n" + "1.5,a\n2.5,b\n" * 9)
    found = command("train", *settings, "hydra.run.dir=none", folder=folder)
    assert found.status == 2
    assert message in found.err
    assert "Traceback" not in found.err
    assert not (folder / "none").exists()
