"""RBMs of other libraries: the same free energies, up to a constant, as by their own formulas."""

import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.neural_network import BernoulliRBM

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.interop import (
    from_pydeep,
    from_rbms,
    from_scikit_learn,
    read_pydeep,
    read_rbms,
    to_scikit_learn,
    write_rbms,
)
from memcomp_lightning.interop.rbms import Hyperparameters
from memcomp_lightning.models import RBM, Normal
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, Spin, all_states

N_VISIBLE, N_HIDDEN = 5, 3
BITS = np.array(list(itertools.product((0.0, 1.0), repeat=N_VISIBLE)))
HIDDEN = np.array(list(itertools.product((0.0, 1.0), repeat=N_HIDDEN)))


def normal(name: str, *shape: int) -> np.ndarray:
    return rng.numpy_stream(0, name).normal(size=shape)


def random_rbm(**kinds: Any) -> RBM:
    rbm = RBM(**kinds, weight_init=Normal(std=0.7), generator=rng.stream(0, "w"))
    with torch.no_grad():
        for bias, name in ((rbm.b, "b"), (rbm.c, "c")):
            bias.copy_(torch.from_numpy(normal(name, *bias.shape)))
    return rbm


def centred(x: Any) -> np.ndarray:
    x = np.asarray(x.detach() if isinstance(x, torch.Tensor) else x, dtype=np.float64).ravel()
    return x - x.mean()


# ------------------------------------------------------------------------------------------------ scikit-learn


def fitted() -> BernoulliRBM:
    data = (normal("data", 40, N_VISIBLE) > 0).astype(np.float64)
    return BernoulliRBM(N_HIDDEN, learning_rate=0.5, n_iter=20, random_state=0).fit(data)


def test_scikit_learns_rbm_has_its_own_free_energy_and_hidden_means_here() -> None:
    theirs = fitted()
    ours = from_scikit_learn(theirs)
    v = torch.from_numpy(BITS)
    np.testing.assert_allclose(ours.free_energy(v).detach(), theirs._free_energy(BITS), rtol=1e-12)
    np.testing.assert_allclose(ours.hidden_mean(v).detach(), theirs.transform(BITS), rtol=1e-12)


def test_our_rbm_is_scikit_learns_there_and_comes_back() -> None:
    ours = random_rbm(n_visible=N_VISIBLE, n_hidden=N_HIDDEN).double()
    theirs = to_scikit_learn(ours)
    theirs.random_state = 3
    flipped, draws = BITS.copy(), np.random.RandomState(3)
    at = (np.arange(len(BITS)), draws.randint(0, N_VISIBLE, len(BITS)))
    flipped[at] = 1 - flipped[at]
    gap = (ours.free_energy(torch.from_numpy(flipped)) - ours.free_energy(torch.from_numpy(BITS))).detach().numpy()
    np.testing.assert_allclose(theirs.score_samples(BITS), -N_VISIBLE * np.logaddexp(0, -gap), rtol=1e-10)
    back = from_scikit_learn(theirs)
    for name, x in ours.state_dict().items():
        assert back.state_dict()[name].equal(x)
    theirs.partial_fit(BITS)
    assert theirs.gibbs(BITS).shape == BITS.shape


def test_spins_are_bits_in_scikit_learn() -> None:
    ours = random_rbm(visible=Spin(N_VISIBLE), hidden=Spin(N_HIDDEN)).double()
    theirs = to_scikit_learn(ours)
    spins = torch.from_numpy(2 * BITS - 1)
    np.testing.assert_allclose(centred(theirs._free_energy(BITS)), centred(ours.free_energy(spins)), atol=1e-12)
    means = (ours.hidden_mean(spins) + 1) / 2
    np.testing.assert_allclose(theirs.transform(BITS), means.detach(), rtol=1e-10)


@pytest.mark.parametrize("kinds", [{"visible": Gaussian(2)}, {"visible": Categorical(2, q=3)}])
def test_scikit_learn_has_no_other_units(kinds: Any) -> None:
    with pytest.raises((SettingError, UserError), match="BernoulliRBM"):
        to_scikit_learn(RBM(n_hidden=2, **kinds))


def test_an_estimator_that_is_not_fitted_is_refused() -> None:
    with pytest.raises(UserError, match="BernoulliRBM has no components_"):
        from_scikit_learn(BernoulliRBM())


# --------------------------------------------------------------------------------------------------------- rbms


def bits_of_rbms() -> SimpleNamespace:
    """A BBRBM has (visible, hidden) weights, torch tensors."""
    parts = {"weight_matrix": (N_VISIBLE, N_HIDDEN), "vbias": (N_VISIBLE,), "hbias": (N_HIDDEN,)}
    return SimpleNamespace(
        name="BBRBM", **{name: torch.from_numpy(normal(name, *shape)) for name, shape in parts.items()}
    )


def potts_of_rbms() -> SimpleNamespace:
    parts = {"weight_matrix": (2, 4, N_HIDDEN), "vbias": (2, 4), "hbias": (N_HIDDEN,)}
    return SimpleNamespace(
        name="PBRBM", **{name: torch.from_numpy(normal(name, *shape)) for name, shape in parts.items()}
    )


def test_bits_of_rbms() -> None:
    theirs = bits_of_rbms()
    w, b, c = (x.numpy() for x in (theirs.weight_matrix, theirs.vbias, theirs.hbias))
    expected = -BITS @ b - np.log1p(np.exp(c + BITS @ w)).sum(1)
    ours = from_rbms(theirs)
    np.testing.assert_allclose(ours.free_energy(torch.from_numpy(BITS)).detach(), expected, rtol=1e-12)


def test_categories_of_rbms() -> None:
    theirs = potts_of_rbms()
    w, b, c = (x.numpy() for x in (theirs.weight_matrix, theirs.vbias, theirs.hbias))
    states = np.array(list(itertools.product(range(4), repeat=2)))
    field = c + w[0, states[:, 0]] + w[1, states[:, 1]]
    expected = -b[0, states[:, 0]] - b[1, states[:, 1]] - np.log1p(np.exp(field)).sum(1)
    ours = from_rbms(theirs)
    v = ours.visible.encode(torch.from_numpy(states)).double()
    np.testing.assert_allclose(ours.free_energy(v).detach(), expected, rtol=1e-12)


@pytest.mark.parametrize(
    "kinds",
    [
        {"n_visible": N_VISIBLE, "n_hidden": N_HIDDEN},
        {"visible": Mixed(Bernoulli(2), Spin(2)), "hidden": Spin(N_HIDDEN)},
        {"visible": Categorical(3, q=3), "hidden": Spin(N_HIDDEN)},
    ],
    ids=["bits", "spins", "categories"],
)
def test_a_file_of_rbms_gives_the_model_back(kinds: Any, tmp_path: Path) -> None:
    ours = random_rbm(**kinds).double()
    write_rbms(ours, tmp_path / "rbm.h5", Hyperparameters(n_chains=4))
    again = read_rbms(tmp_path / "rbm.h5")
    v = all_states(ours.visible, ours.b)
    low = ours.visible.bits().low
    theirs = v if isinstance(ours.visible, Categorical) else (v - low) / ours.visible.bits().width
    np.testing.assert_allclose(centred(again.free_energy(theirs)), centred(ours.free_energy(v)), atol=1e-12)


def test_a_file_of_rbms_holds_what_rbms_reads(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    write_rbms(
        random_rbm(visible=Categorical(3, q=4), n_hidden=2), tmp_path / "rbm.h5", Hyperparameters(n_chains=50)
    )
    with h5py.File(tmp_path / "rbm.h5") as file:
        assert file["model_type"][()] == b"PBRBM"
        assert file["update_1/params/weight_matrix"].shape == (3, 4, 2)
        assert file["update_1/params/vbias"].shape == (3, 4)
        chains = file["parallel_chains"][()]
        assert chains.shape == (50, 3)
        assert set(np.unique(chains)) <= {0, 1, 2, 3}
        assert {"batch_size", "gibbs_steps", "learning_rate", "L1", "L2", "seed"} <= set(file["hyperparameters"])
        torch.Generator().set_state(torch.from_numpy(file["update_1/torch_rng_state"][()]))
        assert file["update_1/numpy_rng_arg1"].shape == (624,)


def test_updates_of_a_file_are_chosen_by_number(tmp_path: Path) -> None:
    """As the library writes them, and as its earlier versions did, without a group of parameters."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "rbm.h5", "w") as file:
        for update in (2, 10, 9):
            group = file.create_group(f"update_{update}")
            for name, shape in (("weight_matrix", (3, 2)), ("vbias", (3,)), ("hbias", (2,))):
                group[name] = np.full(shape, float(update), dtype=np.float32)
    assert read_rbms(tmp_path / "rbm.h5").b.tolist() == [10.0] * 3
    assert read_rbms(tmp_path / "rbm.h5", 9).b.tolist() == [9.0] * 3
    with pytest.raises(UserError, match="no update 3: it has 2, 9, 10"):
        read_rbms(tmp_path / "rbm.h5", 3)


def test_what_rbms_does_not_have_is_refused(tmp_path: Path) -> None:
    for kinds in ({"visible": Gaussian(2)}, {"visible": Mixed(Bernoulli(2), Categorical(2, q=3))}):
        with pytest.raises(SettingError, match="visible units for rbms"):
            write_rbms(RBM(n_hidden=2, **kinds), tmp_path / "rbm.h5")
    with pytest.raises(SettingError, match=r"numbers of states .* \[2, 3\]"):
        write_rbms(RBM(visible=Categorical([2, 3]), n_hidden=2), tmp_path / "rbm.h5")
    with pytest.raises(UserError, match="IGRBM"):
        from_rbms(SimpleNamespace(**{**vars(bits_of_rbms()), "name": "IGRBM"}))
    (tmp_path / "text.h5").write_text("no HDF5")
    with pytest.raises(UserError, match=r"text\.h5 cannot be read as HDF5"):
        read_rbms(tmp_path / "text.h5")
    assert not (tmp_path / "rbm.h5").exists()


# ------------------------------------------------------------------------------------------------------- PyDeep


def of_pydeep(**others: np.ndarray) -> SimpleNamespace:
    """Biases and offsets are rows of one row there."""
    shapes = {
        "w": (N_VISIBLE, N_HIDDEN),
        "bv": (1, N_VISIBLE),
        "bh": (1, N_HIDDEN),
        "ov": (1, N_VISIBLE),
        "oh": (1, N_HIDDEN),
    }
    return SimpleNamespace(**{name: normal(name, *shape) for name, shape in shapes.items()}, **others)


def free_energy_of_pydeep(x: SimpleNamespace, v: np.ndarray) -> np.ndarray:
    """Sum over the hidden units of exp(-E), E as PyDeep's ``energy`` has it."""
    v, h = (v - x.ov)[:, None, :], (HIDDEN - x.oh)[None]
    if hasattr(x, "sigma"):
        of_v = 0.5 * (((v - x.bv) / x.sigma) ** 2).sum(-1)
        coupled = ((v / x.sigma**2) @ x.w * h).sum(-1)
    else:
        of_v = -(v * x.bv).sum(-1)
        coupled = (v @ x.w * h).sum(-1)
    energy = of_v - (h * x.bh).sum(-1) - coupled
    return -np.logaddexp.reduce(-energy, axis=1)


def test_offsets_of_pydeep_go_into_the_biases() -> None:
    theirs = of_pydeep()
    ours = from_pydeep(theirs)
    expected = centred(free_energy_of_pydeep(theirs, BITS))
    np.testing.assert_allclose(centred(ours.free_energy(torch.from_numpy(BITS))), expected, atol=1e-12)
    means = 1 / (1 + np.exp(-((HIDDEN - theirs.oh) @ theirs.w.T + theirs.bv)))
    np.testing.assert_allclose(ours.visible_mean(torch.from_numpy(HIDDEN)).detach(), means, rtol=1e-12)


def test_real_units_of_pydeep_keep_their_deviations() -> None:
    theirs = of_pydeep(sigma=np.exp(normal("sigma", 1, N_VISIBLE)))
    ours, v = from_pydeep(theirs), normal("v", 20, N_VISIBLE)
    expected = centred(free_energy_of_pydeep(theirs, v))
    np.testing.assert_allclose(centred(ours.free_energy(torch.from_numpy(v))), expected, rtol=1e-10, atol=1e-10)
    means = (HIDDEN - theirs.oh) @ theirs.w.T + theirs.bv + theirs.ov
    np.testing.assert_allclose(ours.visible_mean(torch.from_numpy(HIDDEN)).detach(), means, rtol=1e-10, atol=1e-10)


def test_arrays_of_pydeep_are_read_and_pickles_are_not(tmp_path: Path) -> None:
    theirs = of_pydeep()
    np.savez(tmp_path / "rbm.npz", **vars(theirs))
    read = read_pydeep(tmp_path / "rbm.npz")
    assert read.weight.equal(from_pydeep(theirs).weight)
    assert read.b.equal(from_pydeep(theirs).b)
    (tmp_path / "rbm.p").write_bytes(b"\x80\x04}.")
    with pytest.raises(UserError, match=r"pickles, which run code .* numpy\.savez"):
        read_pydeep(tmp_path / "rbm.p")
    np.savez(tmp_path / "objects.npz", **{**vars(theirs), "w": np.array([[None]])})
    with pytest.raises(UserError, match="pickles"):
        read_pydeep(tmp_path / "objects.npz")


def test_an_rbm_of_pydeep_without_offsets_or_with_other_units_is_refused() -> None:
    arrays = vars(of_pydeep())
    with pytest.raises(UserError, match="no array 'ov'"):
        from_pydeep({name: x for name, x in arrays.items() if name != "ov"})
    with pytest.raises(UserError, match="oh has 5 entries: expected 3"):
        from_pydeep({**arrays, "oh": arrays["ov"]})
    with pytest.raises(UserError, match="w has an entry that is NaN"):
        from_pydeep({**arrays, "w": arrays["w"] * np.nan})
    other = type("BinaryRectRBM", (SimpleNamespace,), {"__module__": "pydeep.rbm.model"})(**arrays)
    with pytest.raises(UserError, match="BinaryRectRBM of PyDeep has other units"):
        from_pydeep(other)
