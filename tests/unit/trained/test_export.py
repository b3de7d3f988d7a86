"""A trained run for other programs: every format gives back what the run computes, or is refused whole."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from memcomp_lightning import rng
from memcomp_lightning.cli.commands import export as command
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.tables import TableSchema
from memcomp_lightning.data.tables.columns import Binary, Category, Real, SpinColumn
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.models import (
    DBM,
    DBN,
    RBM,
    BatchNormReluNetwork,
    BoltzmannMachine,
    contact_scores,
    couplings,
)
from memcomp_lightning.models.connectivity import layered
from memcomp_lightning.models.units import (
    Bernoulli,
    Categorical,
    Gaussian,
    Mixed,
    ReLU,
    Spin,
    Units,
)
from memcomp_lightning.modules import CheckpointError, DBNClassifier
from memcomp_lightning.trained import Run, load
from memcomp_lightning.trained.export import FORMATS, export, onnx
from memcomp_lightning.trained.export.plain import compared
from memcomp_lightning.trained.features import transform
from memcomp_lightning.trained.values import values

SCHEMA = TableSchema(
    (
        Real("height", 170.0, 10.0),
        Category("colour", ("blue", "red", "white")),
        Binary("smokes", ("no", "yes")),
        SpinColumn("spin"),
        Category("town", ("a", "b")),
    ),
    Category("species", ("cat", "dog", "emu")),
)
ROWS = Rows(torch.tensor([[0.0, 1, 2, 0, -1.5], [1, -1, 0, 1, 0.25], [1, 1, 1, 1, 2.0]]), torch.tensor([0, 1, 2]))
"""smokes, spin, colour, town, height: in the order of the sites."""


def random_weights(module: nn.Module) -> nn.Module:
    generator = rng.stream(0, "weights")
    with torch.no_grad():
        for name, x in [*module.named_parameters(), *module.named_buffers()]:
            if x.is_floating_point():
                drawn = torch.empty_like(x).normal_(generator=generator)
                x.copy_(drawn.exp() if "precision" in name or "running_var" in name else drawn)
    return module.eval()


def run_of(network: nn.Module, classifier: nn.Module | None = None, schema: Any = None, **settings: Any) -> Run:
    tuned = None if classifier is None else random_weights(classifier)
    return Run(Path("a_run"), random_weights(network), tuned, schema, settings)


def of_table() -> Run:
    """A DBN of all kinds of columns, fine-tuned."""
    network = DBN(hidden_sizes=[4, 3], visible=SCHEMA.units())
    classifier = DBNClassifier(DBN(hidden_sizes=[4, 3], visible=SCHEMA.units()), n_classes=3).network
    return run_of(network, classifier, SCHEMA, seed=1, data={"path": "people.csv"}, pretrain={"stage": {}})


def with_batch_norm() -> nn.Module:
    return DBNClassifier(DBN(5, [4]), n_classes=2, units="batch_norm_relu").network


def kinds_of_hidden(hidden: Units) -> RBM:
    return RBM(n_visible=5, hidden=hidden)


# ------------------------------------------------------------------------------------------------- safetensors


NETWORKS = {
    "mixed": lambda: RBM(visible=SCHEMA.units(), n_hidden=3),
    "hidden kinds": lambda: RBM(n_visible=3, hidden=Mixed(Spin(2), Categorical([2, 3]), ReLU(1))),
    "fixed precision": lambda: RBM(n_visible=3, hidden=Gaussian(2, learned=False)),
    "double": lambda: RBM(n_visible=3, n_hidden=2).double(),
    "dbn": lambda: DBN(hidden_sizes=[4, 2], visible=Spin(3)),
    "dbm": lambda: DBM(hidden_sizes=[4, 2], visible=Spin(3)),
    "machine": lambda: BoltzmannMachine(3, 2, [(0, 3), (1, 3), (2, 4), (0, 1)]),
    "potts": lambda: BoltzmannMachine(visible=Categorical([2, 3, 2]), n_hidden=0),
    "classifier": with_batch_norm,
    "baseline": lambda: BatchNormReluNetwork(5, [4, 3], 2),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_safetensors_give_every_network_back(name: str, tmp_path: Path) -> None:
    run = run_of(NETWORKS[name]())
    export(run, tmp_path / "model.safetensors")
    again = load(tmp_path / "model.safetensors")
    assert str(again.network) == str(run.network)
    own, found = run.network.state_dict(), again.network.state_dict()
    assert found.keys() == own.keys()
    assert all(found[key].equal(x) and found[key].dtype == x.dtype for key, x in own.items())
    assert not again.network.training


def test_safetensors_give_the_run_back(tmp_path: Path) -> None:
    run = of_table()
    export(run, tmp_path / "model.safetensors")
    again = load(tmp_path / "model.safetensors")
    assert again.schema == SCHEMA
    assert again.settings == {"seed": 1, "pretrain": {"stage": {}}}, "where files lay stays at home"
    v, _ = values(run, ROWS)
    assert run.classifier is not None
    assert again.classifier is not None
    assert again.classifier(v).equal(run.classifier(v))
    assert {name: x.tolist() for name, x in transform(again, ROWS).items()} == {
        name: x.tolist() for name, x in transform(run, ROWS).items()
    }


def test_safetensors_keep_that_a_network_was_not_pretrained(tmp_path: Path) -> None:
    export(replace(of_table(), pretrained=False), tmp_path / "model.safetensors")
    again = load(tmp_path / "model.safetensors")
    assert not again.pretrained
    with pytest.raises(UserError, match="was not pretrained"):
        _ = again.model


def test_a_subclass_of_ones_own_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    class Mine(RBM):
        pass

    with pytest.raises(UserError, match="Mine is not a class of memcomp_lightning"):
        export(run_of(Mine(3, 2)), tmp_path / "model.safetensors")
    assert not list(tmp_path.iterdir())


def test_damaged_and_foreign_safetensors_are_refused(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    path = tmp_path / "model.safetensors"
    export(run_of(RBM(3, 2)), path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-3])
    with pytest.raises(CheckpointError, match=r"model\.safetensors is truncated or damaged"):
        load(path)
    path.write_bytes(whole.replace(b'\\"kind\\": \\"rbm\\"', b'\\"kind\\": \\"RBM\\"'))
    with pytest.raises(CheckpointError, match=r"later version .* kind of a network"):
        load(path)
    save_file({"weight": torch.zeros(2, 3)}, path)
    with pytest.raises(CheckpointError, match="memcomp-export did not write it"):
        load(path)
    with pytest.raises(CheckpointError, match="does not exist"):
        load(tmp_path / "other.safetensors")
    with pytest.raises(SettingError, match="says which it holds"):
        load(path, network=RBM(3, 2))
    with pytest.raises(SettingError, match="replica = 1"):
        load(path, replica=1)


# -------------------------------------------------------------------------------------- classifier and features


def sequential(run: Run, folder: Path, what: str) -> nn.Module:
    """Build the module by the line that is printed, where this package could be missing."""
    use = export(run, folder / "model.pt", what=what).use
    names: dict[str, Any] = {"nn": nn, "torch": torch}
    exec(use, names)
    network: nn.Module = names["network"]
    return network


@pytest.mark.usefixtures("allow_global_rng")  # torch's layers draw their first weights there
@pytest.mark.parametrize(
    "network",
    [
        lambda: DBN(5, [4, 3]),
        lambda: kinds_of_hidden(Spin(3)),
        lambda: kinds_of_hidden(Gaussian(3, learned=False)),
        lambda: kinds_of_hidden(Categorical(3, q=2)),
        lambda: BoltzmannMachine(5, 3, layered((5, 3))),
        lambda: kinds_of_hidden(Bernoulli(3)).double(),
    ],
    ids=["dbn", "spins", "real", "categories", "machine", "double"],
)
def test_the_feature_map_is_a_sequential_of_torch(network: Any, tmp_path: Path) -> None:
    run = run_of(network())
    parameter = next(run.network.parameters())
    v = torch.empty(7, 5, dtype=parameter.dtype).uniform_(generator=rng.stream(0, "v"))
    expected = run.network(v) if isinstance(run.network, DBN) else run.model.hidden_mean(v)
    torch.testing.assert_close(sequential(run, tmp_path, "features")(v), expected)


@pytest.mark.usefixtures("allow_global_rng")
@pytest.mark.parametrize("network", [with_batch_norm, lambda: BatchNormReluNetwork(5, [4, 3], 2)])
def test_batch_norm_keeps_its_statistics(network: Any, tmp_path: Path) -> None:
    run = run_of(DBN(5, [4]), network())
    v = torch.empty(7, 5).uniform_(generator=rng.stream(0, "v"))
    assert run.classifier is not None
    torch.testing.assert_close(sequential(run, tmp_path, "classifier")(v), run.classifier(v))


def test_a_program_of_torch_takes_values_of_the_units_in_the_order_of_their_names(tmp_path: Path) -> None:
    run = of_table()
    written = export(run, tmp_path / "people.pt2", what="features")
    said: dict[str, Any] = {"memcomp_lightning.json": ""}
    program = torch.export.load(tmp_path / "people.pt2", extra_files=said).module()
    names = json.loads(said["memcomp_lightning.json"])["inputs"]
    assert names == SCHEMA.entry_names
    row = {"smokes": 1.0, "spin": -1.0, "colour=blue": 1.0, "town=b": 1.0, "height": 0.25}
    v = torch.tensor([[row.get(name, 0.0) for name in names]])
    expected = torch.tensor([x[1] for x in transform(run, ROWS).values()])
    torch.testing.assert_close(program(v)[0], expected)
    assert "smokes, spin, colour=blue" in written.inputs
    assert "h1, h2, h3" in written.outputs


def test_hidden_units_that_torch_has_no_layer_for_are_a_program_all_the_same(tmp_path: Path) -> None:
    run = run_of(kinds_of_hidden(Mixed(Categorical([2, 3]), ReLU(2))))
    with pytest.raises(UserError, match="torch has no layer for Mixed"):
        export(run, tmp_path / "model.pt")
    export(run, tmp_path / "model.pt2")
    v = torch.zeros(2, 5)
    program = torch.export.load(tmp_path / "model.pt2").module()
    torch.testing.assert_close(program(v), run.model.hidden_mean(v))
    assert [path.name for path in tmp_path.iterdir()] == ["model.pt2"]


def by_onnxruntime(path: Path, v: Tensor) -> tuple[Tensor, dict[str, Any]]:
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    said = json.loads(session.get_modelmeta().custom_metadata_map["memcomp_lightning"])
    return torch.from_numpy(session.run(None, {"v": v.numpy()})[0]), said


@pytest.mark.parametrize("what", ["classifier", "features"])
def test_onnx_computes_the_same(what: str, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    run = of_table()
    written = export(run, tmp_path / "people.onnx", what=what)
    v, _ = values(run, ROWS)
    found, said = by_onnxruntime(tmp_path / "people.onnx", v)
    own = run.classifier if what == "classifier" else run.network
    assert own is not None
    torch.testing.assert_close(found, own(v))
    assert said["inputs"] == SCHEMA.entry_names
    assert said["outputs"] == (SCHEMA.class_names if what == "classifier" else ["h1", "h2", "h3"])
    assert said["schema"] == json.loads(json.dumps(SCHEMA.as_json()))
    assert written.check.startswith("onnxruntime: largest difference")
    assert [path.name for path in tmp_path.iterdir()] == ["people.onnx"], "weights are in the file"


@pytest.mark.parametrize(("off", "kept"), [(0.5e-4, True), (2e-4, False), (float("nan"), False)])
def test_an_onnx_file_that_computes_something_else_is_removed(
    off: float, kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    run = run_of(DBN(5, [4]))

    class Session:
        def __init__(self, *_: Any, **__: Any) -> None:
            pass

        def run(self, _: Any, given: dict[str, Any]) -> list[Any]:
            return [(run.network(torch.from_numpy(given["v"])) + off).detach().numpy()]

    monkeypatch.setattr(onnxruntime, "InferenceSession", Session)
    monkeypatch.setattr(onnx, "_write", lambda run, found, path: path.write_bytes(b"a model"))
    if kept:
        assert "5e-05" in export(run, tmp_path / "model.onnx").check
    else:
        with pytest.raises(UserError, match=r"off by .* more than 0\.0001, and was removed"):
            export(run, tmp_path / "model.onnx")
    assert len(list(tmp_path.iterdir())) == kept


def test_differences_of_large_outputs_are_relative() -> None:
    v = torch.ones(4, 1)
    assert "5e-05" in compared(lambda x: 1e3 * x, lambda x: 1e3 * x + 0.05, v)
    with pytest.raises(UserError, match="off by"):
        compared(lambda x: 1e3 * x, lambda x: 1e3 * x + 0.5, v)


@pytest.mark.parametrize(
    ("network", "what", "said"),
    [
        (lambda: DBM(3, [2, 2]), "features", "DBM with couplings between hidden units"),
        (lambda: BoltzmannMachine(3, 0), "features", "no hidden units"),
        (lambda: BatchNormReluNetwork(5, [4], 2), "features", "no hidden means: use what=classifier"),
        (lambda: DBN(3, [2]), "classifier", "no classifier: choose what=features"),
    ],
)
def test_a_run_without_such_a_map_is_refused(network: Any, what: str, said: str, tmp_path: Path) -> None:
    for ending in ("pt", "pt2", "onnx"):
        with pytest.raises(UserError, match=said):
            export(run_of(network()), tmp_path / f"model.{ending}", what=what)
    assert not list(tmp_path.iterdir())


# ----------------------------------------------------------------------------------------------------- couplings


def table_of(path: Path) -> list[tuple[str, str, str, float]]:
    with path.open(newline="") as file:
        return [(row["term"], row["first"], row["second"], float(row["value"])) for row in csv.DictReader(file)]


@pytest.mark.parametrize(
    "network",
    [
        lambda: RBM(visible=SCHEMA.units(), n_hidden=3),
        lambda: BoltzmannMachine(visible=SCHEMA.units(), n_hidden=2),
    ],
    ids=["rbm", "machine"],
)
def test_the_parameters_of_the_table_are_those_of_the_energy(network: Any, tmp_path: Path) -> None:
    run = run_of(network(), schema=SCHEMA)
    export(run, tmp_path / "parameters.csv")
    v, _ = values(run, ROWS)
    generator = rng.stream(0, "h")
    h = torch.empty(3, run.model.n_hidden).bernoulli_(generator=generator)
    names = [*SCHEMA.entry_names, *(f"h{k + 1}" for k in range(h.shape[1]))]
    x = dict(zip(names, torch.cat((v, h), dim=1).T, strict=True))
    energy = torch.zeros(3)
    for term, first, second, value in table_of(tmp_path / "parameters.csv"):
        if term == "weight":
            energy -= value * x[first] * x[second]
        elif term == "bias":
            energy -= value * x[first]
        else:
            assert term == "precision"
            energy += value * x[first] ** 2 / 2
    torch.testing.assert_close(energy, run.model.energy(v, h).detach(), rtol=1e-5, atol=1e-5)


def test_pairs_of_categories_have_couplings_and_columns_have_contacts(tmp_path: Path) -> None:
    schema = TableSchema(tuple(Category(name, ("x", "y", "z")[:q]) for name, q in (("a", 2), ("b", 3), ("c", 3))))
    run = run_of(RBM(visible=schema.units(), n_hidden=4), schema=schema)
    export(run, tmp_path / "couplings.csv")
    table = table_of(tmp_path / "couplings.csv")
    found, names = couplings(run.network), schema.entry_names  # type: ignore[arg-type]
    pairs = {(first, second): value for term, first, second, value in table if term == "coupling"}
    assert len(pairs) == 2 * 3 + 2 * 3 + 3 * 3
    for (first, second), value in pairs.items():
        assert value == pytest.approx(float(found.J[names.index(first), names.index(second)]), rel=1e-6)
    fields = {first: value for term, first, _, value in table if term == "field"}
    assert [fields[name] for name in names] == pytest.approx(found.h.tolist(), rel=1e-6)
    contacts = [(first, second, value) for term, first, second, value in table if term == "contact"]
    scores = contact_scores(found)
    assert {(a, b) for a, b, _ in contacts} == {("a", "b"), ("a", "c"), ("b", "c")}
    for a, b, value in contacts:
        assert value == pytest.approx(float(scores["abc".index(a), "abc".index(b)]), rel=1e-6)
    assert [value for *_, value in contacts] == sorted((value for *_, value in contacts), reverse=True)


# --------------------------------------------------------------------------------------------------- the command


def test_the_command_writes_what_the_ending_says_and_says_what_it_wrote(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export(of_table(), tmp_path / "people.safetensors")
    command.main([str(tmp_path / "people.safetensors"), f"output={tmp_path}/people.pt"])
    said = capsys.readouterr().out
    assert f"{tmp_path}/people.pt: classifier" in said
    assert "inputs: v, (rows, 8) float32: smokes, spin, colour=blue" in said
    assert "outputs: logits, (rows, 3) float32: cat, dog, emu" in said
    assert "check: largest difference 0 over 32 rows" in said
    assert "nn.Sequential(nn.Linear(8, 4), nn.Sigmoid()" in said


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["output=FOLDER/model.bin"], r"expected a file that ends in \.safetensors, "),
        (["format=onx"], "format = 'onx' is not allowed: expected one of 'safetensors'"),
        (["format=onnx"], r"expected a file that ends in \.onnx"),
        (["what=classifier"], "what = 'classifier' is not allowed: expected model, for format=safetensors"),
        (["output=FOLDER/there.csv"], "the file is there already"),
        (["output=FOLDER/none/model.csv"], "there is no such folder"),
        (["output=FOLDER/a.h5"], "deep belief network of 2 layers"),
        (["output=FOLDER/a.csv"], "deep belief network of 2 layers"),
    ],
)
def test_the_command_refuses_before_it_writes(
    settings: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export(of_table(), tmp_path / "people.safetensors")
    (tmp_path / "there.csv").touch()
    before = sorted(tmp_path.iterdir())
    with pytest.raises(SystemExit):
        command.main(
            [str(tmp_path / "people.safetensors"), *(x.replace("FOLDER", str(tmp_path)) for x in settings)]
        )
    assert re.search(said, capsys.readouterr().err)
    assert sorted(tmp_path.iterdir()) == before


def test_a_missing_package_is_named_with_the_line_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from memcomp_lightning.trained import export as formats

    monkeypatch.setattr(formats, "find_spec", lambda name: None if name.startswith("onnxr") else object())
    with pytest.raises(UserError, match=r"pip install onnxruntime$"):
        export(run_of(DBN(3, [2])), tmp_path / "model.onnx")


def test_every_format_has_endings_of_its_own_and_a_line_in_the_docs() -> None:
    endings = [ending for one in FORMATS.values() for ending in one.endings]
    assert len(endings) == len(set(endings))
    page = (Path(__file__).parents[3] / "docs/export.md").read_text()
    for name, one in FORMATS.items():
        cells = ([name], one.endings, one.what)
        assert "".join(f"| {', '.join(f'`{x}`' for x in cell)} " for cell in cells) in page
