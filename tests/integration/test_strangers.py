"""A run folder that somebody sent: none of its code runs, and nothing outside is written, unless it is trusted."""

import json
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf
from running import QUIET, Outcome

import memcomp_lightning
from memcomp_lightning.errors import UserError
from memcomp_lightning.files import inside
from memcomp_lightning.modules.weights import LastCheckpoint
from memcomp_lightning.runs.folder import RunFolder
from memcomp_lightning.runs.trust import check_targets, foreign

Run = Callable[..., Outcome]
ONE = [
    *QUIET,
    "data=shifting_bars",
    "model=one_layer",
    "model.hidden_sizes=[3]",
    "pretrain.iterations=1",
    "finetune.iterations=0",
]
THEIRS = """
from pathlib import Path

MARK = Path(__file__).with_name("ran")
MARK.touch()

class Part:
    def __init__(self, **settings):
        pass
"""
"""A module in the folder where the command is typed, as notebooks and `python -m` import it."""

WAYS = {
    "a part": ["sampler._target_=theirs.Part"],
    "a part of the standard library": ["+callbacks.pretrain.x={_target_: os.system, command: touch ran}"],
    "a function of ours": [
        "+callbacks.pretrain.x={_target_: memcomp_lightning.files.write_text, path: ran, text: x}"
    ],
    "what a module of ours imports": [
        "+callbacks.pretrain.x={_target_: memcomp_lightning.data.module.Path.touch}"
    ],
    "a part that an interpolation stands for": [
        "+hidden={_target_: theirs.Part}",
        "+callbacks.pretrain.x='${hidden}'",
    ],
    "a name that an interpolation stands for": ["+hidden=theirs.Part", "sampler._target_='${hidden}'"],
    "a part inside of another": ["+callbacks.pretrain.x={_target_: builtins.list, x: [{_target_: theirs.Part}]}"],
    "their settings": ["hydra.searchpath=['file://theirs']", "sampler=theirs"],
    "Hydra's settings in theirs": ["hydra.searchpath=['file://theirs']", "+hidden=theirs"],
    "settings of a package": ["hydra.searchpath=[pkg://theirs]"],
    "Hydra's callbacks": ["+hydra.callbacks.x._target_=theirs.Part"],
    "Hydra's launcher": ["hydra.launcher._target_=theirs.Part"],
    "Hydra's groups": ["hydra/launcher=theirs"],
    "a group in Hydra's settings": ["+callbacks@hydra.callbacks.x=minimal"],
    "a place above": ["logger=csv", "logger.csv.save_dir=../ran"],
    "a place elsewhere": ["logger=csv", "logger.csv.save_dir=/ran"],
    "a name that leads above": ["logger=csv", "logger.csv.name=../../ran"],
    "a place after an interpolation": ["logger=csv", "logger.csv.save_dir='${hydra:runtime.output_dir}/../ran'"],
    "a curve of a figure": [
        "experiment=figure4",
        "+figure.curves.x={label: x, overrides: ['+callbacks.pretrain.x={_target_: theirs.Part}']}",
    ],
    "a program": ["experiment=density", "density.peers=theirs.py"],
    "the Python of a program": ["experiment=density", "+density.peers_python=theirs.py"],
    "a reference that is known later alone": [
        "logger=csv",
        "+logger.csv.prefix='${oc.create:{_target_:theirs.Part}}'",
    ],
    "a reference that is written to be read twice": [
        "+callbacks.pretrain.x={_target_: memcomp_lightning.callbacks.StateWeights,"
        " alphabet: '\\${oc.create:{_target_:theirs.Part}}'}"
    ],
    "a place that a reference leads to": ["logger=csv", "logger.csv.name='${hydra:runtime.cwd}/ran'"],
    "settings above those of ours": ["experiment=../../../../proc/self/cwd/theirs/sampler/theirs"],
    "settings elsewhere": ["sampler=/proc/self/cwd/theirs/sampler/theirs"],
}


pytestmark = pytest.mark.xdist_group("strangers")  # one worker trains what they send

TRAINED: list[Path] = []
"""The folder of the run that all tests send."""


@pytest.fixture
def sent(memcomp_train: Run, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run, beside code that must not run."""
    if not TRAINED:
        folder = tmp_path_factory.mktemp("trained")
        outcome = memcomp_train(*ONE, f"hydra.run.dir={folder}/run")
        assert outcome.status == 0, outcome.err
        TRAINED.append(folder / "run")
    shutil.copytree(TRAINED[0], "sent")
    monkeypatch.syspath_prepend(".")
    Path("theirs.py").write_text(THEIRS)
    Path("theirs/sampler").mkdir(parents=True)
    Path("theirs/sampler/theirs.yaml").write_text("_target_: theirs.Part\n")
    Path("theirs/hidden").mkdir()
    Path("theirs/hidden/theirs.yaml").write_text("# @package hydra.callbacks.x\n_target_: theirs.Part\n")
    return Path("sent")


def rewrite(folder: Path, *more: str) -> None:
    written = json.loads((folder / "overrides.json").read_text())
    kept = [o for o in written["overrides"] if not o.startswith("logger=")]
    written["overrides"] = [*([] if more[0].startswith("experiment=") else kept), *more]
    (folder / "overrides.json").write_text(json.dumps(written))


def test_what_a_run_names_must_be_trusted(memcomp_train: Run, sent: Path) -> None:
    begun = (sent / "overrides.json").read_text()
    for number, (way, overrides) in enumerate(WAYS.items()):
        (sent / "overrides.json").write_text(begun)
        rewrite(sent, *overrides)
        of_study = overrides[0].startswith("experiment=")
        setting = "continue" if number % 3 == 0 and not of_study else "resume"
        outcome = memcomp_train(f"{setting}={sent}")
        assert outcome.status != 0, way
        told = ("If you trust it, type memcomp-train", "somebody typed or wrote it")
        assert any(text in outcome.err for text in told), (way, outcome.err)
        assert not any(path.exists() for path in (Path("ran"), Path("../ran"), Path("/ran"))), way


def test_the_line_that_is_told_goes_on(memcomp_train: Run, sent: Path) -> None:
    part = "+callbacks.pretrain.theirs={_target_: theirs_of_trust.Quiet}"
    Path("theirs_of_trust.py").write_text("from lightning import Callback\nclass Quiet(Callback): pass\n")
    assert memcomp_train(*ONE, part, "hydra.run.dir=own").status == 0  # what is typed is trusted
    refused = memcomp_train("continue=own", "pretrain.iterations=1", "hydra.run.dir=more")
    assert "theirs_of_trust.Quiet, which is no part of this package" in refused.err
    line = shlex.split(refused.err.partition("type memcomp-train ")[2])
    assert "trusted=[theirs_of_trust]" in line
    outcome = memcomp_train(*line)
    assert outcome.status == 0, outcome.err
    assert memcomp_train("resume=own", "trusted=theirs_of_trust").status == 0


def test_a_checkpoint_says_nothing_of_what_to_remove(tmp_path: Path) -> None:
    keeps = LastCheckpoint(dirpath=tmp_path)
    keeps.load_state_dict({"best_model_path": "local:///somewhere", "dirpath": str(tmp_path)})
    assert keeps.best_model_path == ""


@pytest.mark.parametrize("name", ["weights", "train.log"])
def test_links_are_refused(memcomp_train: Run, sent: Path, name: str) -> None:
    (sent / name).rename("elsewhere")
    (sent / name).symlink_to(Path("elsewhere").absolute())
    refused = memcomp_train("resume=sent")
    assert f"sent/{name} is a link, which no run makes" in refused.err


def test_texts_that_would_be_references_again(sent: Path) -> None:
    settings = sent / "settings.yaml"
    text = settings.read_text()
    settings.write_text(
        text.replace("_target_: memcomp_lightning.models.Normal", "x: '\\${oc.create:{_target_:theirs.Part}}'")
    )
    with pytest.raises(UserError, match="could stand for anything"):
        memcomp_lightning.load(sent)
    assert not Path("ran").exists()


def test_a_report_writes_into_its_folder(sent: Path) -> None:
    with pytest.raises(UserError, match="leads out of this folder"):
        inside(sent, "../ran")
    assert inside(sent, "weights") == sent / "weights"


def test_what_is_typed_is_trusted(memcomp_train: Run, sent: Path) -> None:
    Path("typed_by_hand.py").write_text("from lightning import Callback\nclass Quiet(Callback): pass\n")
    part = "+callbacks.pretrain.own={_target_: typed_by_hand.Quiet}"
    outcome = memcomp_train("continue=sent", part, "pretrain.iterations=1", "hydra.run.dir=more")
    assert outcome.status == 0, outcome.err


def test_trust_without_a_run(memcomp_train: Run) -> None:
    assert "trusted=x is for resume=FOLDER and continue=FOLDER" in memcomp_train(*ONE, "trusted=[x]").err


def test_a_choice_is_no_way_in(memcomp_train: Run, sent: Path) -> None:
    result = json.loads((sent / "result.json").read_text())
    result["choice"] = {"setting": "sampler._target_", "value": "theirs.Part"}
    (sent / "result.json").write_text(json.dumps(result))
    outcome = memcomp_train("continue=sent", "pretrain.iterations=1", "hydra.run.dir=more")
    assert "result.json is damaged: its choice is no number" in outcome.err
    assert not Path("ran").exists()


def test_modules_are_not_even_imported_to_look_at_them(sent: Path) -> None:
    settings = sent / "settings.yaml"
    settings.write_text(settings.read_text().replace("memcomp_lightning.models.Normal", "theirs.Part"))
    with pytest.raises(UserError, match=r"theirs\.Part, which is no part of a model of this package"):
        memcomp_lightning.load(sent)
    assert not Path("ran").exists()


def test_every_option_of_ours_may_be_named() -> None:
    """But a quantum annealer's, which costs money."""
    for path in sorted((Path(memcomp_lightning.__file__).parent / "conf").rglob("*.yaml")):
        config = OmegaConf.load(path)
        if path.parent.name in ("hydra", "launcher", "sweeper", "hparams") or "hydra" in config:
            continue
        names = foreign(OmegaConf.create({path.parent.name: config}), Path("run"))
        assert not names or path.stem == "dwave_qpu", (path, names)


def test_packages_do_not_stand_for_longer_names(tmp_path: Path) -> None:
    for target in ("torch.optimised.Part", "lightning.pytorch.Trainer.fit", "memcomp_lightning.modelsx.Part"):
        with pytest.raises(UserError, match=r"no part of a model|which this version"):
            check_targets({"_target_": target}, "x", tmp_path)
        assert foreign(OmegaConf.create({"x": {"_target_": target}}), tmp_path)
    check_targets({"_target_": "torch.optim.lr_scheduler.StepLR"}, "x", tmp_path)
    assert not foreign(OmegaConf.create({"x": {"_target_": "torch.optim.lr_scheduler.StepLR"}}), tmp_path)


DAMAGED = [
    ("a: &x [1, 2]\nb: *x\n", "refers to its own parts"),
    ("a: " + "x" * 2**20, "has more than 1048576 bytes"),
    ("a: [1, 2", "is damaged"),
    ("a: " + "[" * 1000 + "]" * 1000, "is damaged"),
]


def test_settings_are_read_with_limits(sent: Path) -> None:
    for content, said in DAMAGED:
        (sent / "settings.yaml").write_text(content)
        with pytest.raises(UserError, match=said):
            _ = RunFolder(sent).settings


def test_overrides_are_read_with_limits(memcomp_train: Run, sent: Path) -> None:
    for content in ('{"overrides": 3}', '{"overrides": [3]}', "[]", "3", "[" * 100_000, '{"a": '):
        (sent / "overrides.json").write_text(content)
        outcome = memcomp_train("resume=sent")
        assert outcome.status != 0
        assert "overrides.json is damaged" in outcome.err


def test_our_own_settings_have_no_references(sent: Path) -> None:
    tokens = yaml.scan((sent / "settings.yaml").read_text())
    assert not any(isinstance(token, yaml.AnchorToken) for token in tokens)
