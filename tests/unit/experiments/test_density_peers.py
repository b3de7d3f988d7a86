"""The peers of experiment=density: their distributions against enumeration of all states, and their protocol."""

import importlib.util
import json
import subprocess
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch

from memcomp_lightning import rng

sys.path.insert(0, str(Path(__file__).parents[3] / "experiments" / "density"))
import bits
import hidden_tree
import masked
import trees

FOLDER = Path(bits.__file__).parent
N = 8
STATES = np.array(list(product([0, 1], repeat=N)), dtype=np.uint8)


def loaded():
    """The program as a module; another experiment has a peers.py too."""
    spec = importlib.util.spec_from_file_location("density_peers", FOLDER / "peers.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


peers = loaded()


@pytest.fixture(scope="module")
def rows():
    """A Markov chain of N bits: 600, 200 and 4000 rows, whose best tree is a path."""
    generator = rng.numpy_stream(0, "rows")
    stay = np.array([0.9, 0.8, 0.95, 0.7, 0.85, 0.75, 0.9])
    x = np.empty((4800, N), np.uint8)
    x[:, 0] = generator.random(4800) < 0.4
    for i in range(1, N):
        x[:, i] = np.where(generator.random(4800) < stay[i - 1], x[:, i - 1], generator.random(4800) < 0.3)
    return x[:600], x[600:800], x[800:]


def tables(generator, states=3):
    step = generator.dirichlet(np.ones(states), size=(N, states))
    one = generator.uniform(0.05, 0.95, (N, states))
    start = generator.dirichlet(np.ones(states))
    return hidden_tree.Tables(*(np.float32(part) for part in (start, step, np.stack([1 - one, one], axis=2))))


TREE = trees.Tree(np.array([3, 1, 5, 0, 2, 4, 6, 7]), np.array([1, 3, 1, -1, 5, 3, 5, 6]))


def enumerated(parts, rows):
    """log p(x) and expected counts of the hidden tree, by a sum over all states of all latents."""
    h = len(parts.start)
    assignments = np.array(list(product(range(h), repeat=N)))
    log_prior = np.log(parts.start[assignments[:, 3]].astype(float))
    for i in range(N):
        if i != 3:
            log_prior += np.log(parts.step[i, assignments[:, TREE.parent[i]], assignments[:, i]])
    counts = hidden_tree.Tables(*(np.zeros(part.shape) for part in parts))
    log_likelihood = []
    for row in rows:
        joint = np.exp(log_prior + sum(np.log(parts.bit[i, assignments[:, i], row[i]]) for i in range(N)))
        log_likelihood.append(np.log(joint.sum()))
        share = joint / joint.sum()
        np.add.at(counts.start, assignments[:, 3], share)
        for i in range(N):
            np.add.at(counts.bit, (i, assignments[:, i], row[i]), share)
            if i != 3:
                np.add.at(counts.step, (i, assignments[:, TREE.parent[i]], assignments[:, i]), share)
    return np.array(log_likelihood), counts


def test_messages_of_the_hidden_tree_are_those_of_enumeration():
    parts = tables(rng.numpy_stream(1, "tables"))
    rows = STATES[[0, 37, 255, 170]]
    log_likelihood, counts = enumerated(parts, rows)
    np.testing.assert_allclose(hidden_tree.log_likelihood(parts, TREE, rows), log_likelihood, rtol=1e-5)
    found, total = hidden_tree.expected_counts(parts, TREE, rows)
    assert total == pytest.approx(log_likelihood.sum(), rel=1e-5)
    for a, b in zip(found, counts, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)


def test_a_step_of_em_raises_the_likelihood_of_its_rows(rows):
    means = bits.smoothed_means(rows[0], 1.0)
    parts = tables(rng.numpy_stream(2, "tables"))
    reached = []
    for _ in range(6):
        counts, total = hidden_tree.expected_counts(parts, TREE, rows[0])
        reached.append(total)
        parts = hidden_tree.maximised(counts, 1e-6, means)
    assert (np.diff(reached) > 0).all()


@pytest.mark.parametrize(
    ("fit", "settings", "nats"),
    [
        (bits.independent, {"pseudocount": 1.0}, None),
        (bits.mixture, {"components": 12, "pseudocount": 1.0}, 0.25),
        (trees.chow_liu, {"pseudocount": 1.0}, 0.05),
        (hidden_tree.hidden_tree, {"states": 4, "pseudocount": 1.0}, 0.1),
        (masked.masked, {"masks": 2, "hidden": 20, "rate": 0.01, "decay": 0.01}, 0.1),
    ],
)
def test_distributions_sum_to_one_and_come_near_the_truth(rows, fit, settings, nats, monkeypatch):
    monkeypatch.setattr(masked, "_UPDATES", 400)
    train, valid, test = rows
    found = fit(train, valid, seed=0, **settings)
    assert np.exp(found.log_likelihood(STATES)).sum() == pytest.approx(1, abs=1e-4)
    alone = bits.independent(train, valid, seed=0, pseudocount=1.0).log_likelihood(test).mean()
    # Of the family of the truth, and fitted to the very rows.
    best = trees.chow_liu(test, valid, seed=0, pseudocount=0.01).log_likelihood(test).mean()
    reached = found.log_likelihood(test).mean()
    assert alone < best - 2
    if nats is None:
        assert reached == pytest.approx(alone)
    else:
        assert best - nats < reached < best + 0.01


def test_the_chow_liu_tree_of_a_chain_is_the_chain(rows):
    tree = trees.chow_liu_tree(rows[2], 0.1)
    assert {tuple(sorted((i, int(p)))) for i, p in enumerate(tree.parent) if p >= 0} == {
        (i, i + 1) for i in range(N - 1)
    }
    seen = [int(i) for i in tree.order]
    assert all(tree.parent[i] in seen[:k] for k, i in enumerate(seen) if k)


def test_constant_columns_are_joined_to_the_tree(rows):
    train = rows[0].copy()
    train[:, 2] = 0
    assert np.exp(
        trees.chow_liu(train, train, seed=0, pseudocount=1.0).log_likelihood(STATES)
    ).sum() == pytest.approx(1)


def test_an_output_of_the_masked_network_sees_only_columns_before_its_own():
    generator = torch.Generator().manual_seed(0)
    network = masked.MaskedNetwork(np.full(N, 0.4), 30, 3, generator)
    with torch.no_grad():
        network.direct.normal_(generator=generator)
    for k, mask in enumerate(network.masks):
        x = torch.full((1, N), 0.5, requires_grad=True)
        jacobian = torch.stack(
            [torch.autograd.grad(network.logits(x, mask)[0, i], x, retain_graph=True)[0][0] for i in range(N)]
        )
        depends = (jacobian != 0).sum(1)
        assert sorted(depends.tolist()) == list(range(N)), "an order of all columns, each of them seen"
        if k == 0:
            assert (jacobian.triu() == 0).all()


def test_columns_are_split_as_deeprob_splits_them():
    if importlib.util.find_spec("deeprob") is None:
        pytest.skip("needs deeprob-kit")
    import circuits
    from deeprob.spn.learning.splitting.gvs import gvs_cols
    from deeprob.spn.structure.leaf import Bernoulli

    x = rng.numpy_stream(3, "rows").integers(2, size=(300, 6)).astype(np.float32)
    x[:, 1] = np.where(np.arange(300) % 5, x[:, 0], x[:, 1])
    x[:, 4] = np.where(np.arange(300) % 4, x[:, 2], x[:, 4])
    domains = [[0, 1]] * 6
    for seed in range(8):
        mine, theirs = (
            split(x, [Bernoulli] * 6, domains, np.random.RandomState(seed), p=5.0)
            for split in (circuits.split_columns, gvs_cols)
        )
        np.testing.assert_array_equal(mine, theirs)


def test_every_start_lies_on_its_axes_and_no_search_begins_without():
    for name, peer in peers.listed().items():
        assert peer["axes"].keys() == peer["start"].keys(), name
        for setting, values in peer["axes"].items():
            assert peer["start"][setting] in values, (name, setting)
            assert 2 <= len(values) <= 5, (name, setting)
    assert {name for name, peer in peers.listed().items() if peer["likelihood"] == "rbm"} == {"sklearn_rbm"}


def test_a_package_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "deeprob" else object())
    found = peers.listed()
    assert found["sum_product"]["missing"] == "pip install --no-deps deeprob-kit==1.1.0"
    assert found["masked"]["missing"] is None


def written(folder, rows):
    files = {
        split: folder / f"{split}.csv{'.gz' if split == 'test' else ''}" for split in ("train", "valid", "test")
    }
    for file, part in zip(files.values(), rows, strict=True):
        np.savetxt(file, part, "%d", delimiter=",")
    return [text for split, file in files.items() for text in (f"--{split}", str(file))]


def test_the_program_writes_mean_log_likelihoods(rows, tmp_path):
    out = tmp_path / "chow_liu.json"
    program = [sys.executable, str(FOLDER / "peers.py")]
    arguments = [*written(tmp_path, rows), "--settings", '{"pseudocount": 2}', "--seed", "3", "--out", str(out)]
    subprocess.run([*program, "chow_liu", *arguments], check=True, cwd=tmp_path)
    found = json.loads(out.read_text())
    fitted = trees.chow_liu(rows[0], rows[1], seed=3, pseudocount=2.0)
    assert found["valid"] == pytest.approx(fitted.log_likelihood(rows[1]).mean())
    assert found["test"] == pytest.approx(fitted.log_likelihood(rows[2]).mean())
    assert 0 < found["seconds"] < 10
    assert found["note"] == ""
    done = subprocess.run([*program, "--list"], check=True, capture_output=True, text=True)
    assert json.loads(done.stdout) == peers.listed()


def test_the_weights_of_an_rbm_lie_beside_the_json(rows, tmp_path):
    out = tmp_path / "rbm.json"
    settings = '{"n_components": 3, "n_iter": 1}'
    peers.main(["sklearn_rbm", *written(tmp_path, rows), "--settings", settings, "--out", str(out)])
    found = json.loads(out.read_text())
    assert found.keys() == {"weights", "seconds", "note"}
    with np.load(found["weights"]) as weights:
        assert {name: (part.shape, part.dtype) for name, part in weights.items()} == {
            "weight": ((3, N), np.float32),
            "b": ((N,), np.float32),
            "c": ((3,), np.float32),
        }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "magic"}, "magic: not a peer; there are independent"),
        ({"--settings": "{"}, "--settings {: not JSON"),
        ({"--settings": '{"states": 8}'}, "--settings states: no such setting; there are pseudocount"),
        ({"--settings": '{"pseudocount": 0}'}, "--settings pseudocount=0: not a number above 0"),
        ({"--train": "nowhere.csv"}, "nowhere.csv: no such file"),
        ({"--valid": "narrow.csv"}, "narrow.csv: 2 columns, but"),
        ({"--test": "letters.csv"}, "letters.csv: not a table of 0 and 1"),
        ({"--test": "two.csv"}, "two.csv: holds 2; only 0 and 1 are allowed"),
        ({"--test": "empty.csv"}, "empty.csv: no rows"),
        ({"--out": "nowhere/out.json"}, "--out nowhere/out.json: no folder nowhere"),
        ({"--seed": "x"}, "argument --seed: invalid int value: 'x'"),
    ],
)
def test_errors_are_one_line(rows, tmp_path, monkeypatch, capsys, change, message):
    monkeypatch.chdir(tmp_path)
    for name, text in {"narrow": "0,1\n", "letters": "a,b\n", "two": "0,2\n", "empty": ""}.items():
        Path(f"{name}.csv").write_text(text)
    texts = written(tmp_path, rows)
    given = {"name": "chow_liu", **dict(zip(texts[::2], texts[1::2], strict=True)), "--out": "out.json"} | change
    with pytest.raises(SystemExit) as left:
        peers.main([given.pop("name"), *(text for pair in given.items() for text in pair)])
    told = capsys.readouterr().err
    assert left.value.code == 2
    assert told.count("\n") == 1
    assert message in told
    assert not Path("out.json").exists()
