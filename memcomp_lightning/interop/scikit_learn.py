"""scikit-learn's ``BernoulliRBM``, both ways."""

from typing import Any

from memcomp_lightning.errors import UserError
from memcomp_lightning.interop.parameters import in_bits, rbm_of, tensor_of
from memcomp_lightning.models import RBM


def from_scikit_learn(estimator: Any) -> RBM:
    r"""The RBM of a fitted ``sklearn.neural_network.BernoulliRBM``.

    Its energy is ours: ``components_`` is W, ``(n_components, n_features)``, ``intercept_visible_`` is b and
    ``intercept_hidden_`` is c, in its precision.

    Raises:
        UserError: It is not fitted, or is something else.

    >>> from sklearn.neural_network import BernoulliRBM
    >>> from_scikit_learn(BernoulliRBM(2, random_state=0, n_iter=1).fit([[0.0, 1.0, 1.0]])).n_visible
    3
    """
    names = ("components_", "intercept_visible_", "intercept_hidden_")
    missing = [name for name in names if not hasattr(estimator, name)]
    if missing:
        raise UserError(f"{type(estimator).__name__} has no {missing[0]}: expected a BernoulliRBM after its fit.")
    weight, b, c = (tensor_of(getattr(estimator, name), name) for name in names)
    return rbm_of(weight, b, c)


def to_scikit_learn(rbm: RBM) -> Any:
    """A fitted ``BernoulliRBM`` with the parameters of an RBM.

    ``transform``, ``gibbs``, ``score_samples`` and ``partial_fit`` work on it. Spins are written in bits: give it
    (v + 1) / 2.

    Raises:
        SettingError: The RBM has units that are no bits or spins.
    """
    from sklearn.neural_network import BernoulliRBM

    bits = in_bits(rbm, "BernoulliRBM")
    if bits.visible.n_sites != bits.n_visible:
        raise UserError("BernoulliRBM has no categories: export them with format=rbms.")
    estimator = BernoulliRBM(n_components=bits.n_hidden)
    estimator.components_ = bits.weight.detach().cpu().numpy().copy()
    estimator.intercept_visible_ = bits.b.detach().cpu().numpy().copy()
    estimator.intercept_hidden_ = bits.c.detach().cpu().numpy().copy()
    estimator.n_features_in_ = bits.n_visible
    return estimator
