"""RBMs of PyDeep (Melchior, Fischer & Wiskott 2016), which are centred."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from memcomp_lightning.array_files import ArrayFileError, opened_arrays
from memcomp_lightning.errors import UserError
from memcomp_lightning.interop.parameters import rbm_of, tensor_of
from memcomp_lightning.models import RBM
from memcomp_lightning.models.units import Gaussian

_CLASSES = {
    "BinaryBinaryRBM": False,
    "GaussianBinaryRBM": False,
    "GaussianBinaryVarianceRBM": True,
}
"""Classes of PyDeep that are RBMs here, too, and whether training changes their sigma."""

_PARTS = ("w", "bv", "bh", "ov", "oh")


def from_pydeep(rbm: Any) -> RBM:
    r"""The RBM of an object of PyDeep, exactly, in float64.

    PyDeep's energies have offsets. Of a ``BinaryBinaryRBM``,

    .. math:: E(v, h) = -(v - o_v) \cdot b_v - (h - o_h) \cdot b_h - (v - o_v)^T W (h - o_h)

    which has our weights :math:`W^T` and the biases :math:`b = b_v - W o_h` and :math:`c = b_h - W^T o_v`, up to a
    constant. Of a ``GaussianBinaryRBM`` with the deviations :math:`\sigma`,

    .. math:: E(v, h) = \frac{1}{2} \left\| \frac{v - o_v - b_v}{\sigma} \right\|^2 - (h - o_h) \cdot b_h
              - \left(\frac{v - o_v}{\sigma^2}\right)^T W (h - o_h)

    the precision is :math:`1 / \sigma^2`, the weights are :math:`(W / \sigma^2)^T`, and
    :math:`b = (o_v + b_v - W o_h) / \sigma^2`, :math:`c = b_h - (W / \sigma^2)^T o_v`.

    Args:
        rbm: An object with the arrays ``w``, ``(n_visible, n_hidden)``, ``bv``, ``bh``, ``ov`` and ``oh``, and
            with ``sigma`` if its visible units are real; or these arrays by name.

    Raises:
        UserError: A class of PyDeep with other units; an array is missing or has a wrong shape.
    """
    name = type(rbm).__name__
    if type(rbm).__module__.startswith("pydeep") and name not in _CLASSES:
        raise UserError(f"{name} of PyDeep has other units: expected a {', '.join(_CLASSES)}.")
    names = (*_PARTS, "sigma")
    arrays = (
        rbm if isinstance(rbm, Mapping) else {part: getattr(rbm, part) for part in names if hasattr(rbm, part)}
    )
    missing = [part for part in _PARTS if part not in arrays]
    if missing:
        raise UserError(f"no array {missing[0]!r}: expected an RBM of PyDeep, which has {', '.join(_PARTS)}.")
    w = tensor_of(arrays["w"], "w").double()
    if w.ndim != 2:
        raise UserError(f"w has the shape {tuple(w.shape)}: expected (n_visible, n_hidden).")

    def row(part: str, n: int) -> torch.Tensor:
        found = tensor_of(arrays[part], part).double().flatten()
        if len(found) != n:
            raise UserError(f"{part} has {len(found)} entries: expected {n}, as w has the shape {tuple(w.shape)}.")
        return found

    n_visible, n_hidden = w.shape
    bv, ov, bh, oh = row("bv", n_visible), row("ov", n_visible), row("bh", n_hidden), row("oh", n_hidden)
    if "sigma" not in arrays:
        return rbm_of(w.mT, bv - w @ oh, bh - ov @ w)
    sigma = row("sigma", n_visible)
    if not bool((sigma > 0).all()):
        raise UserError(f"sigma has an entry {float(sigma.min()):g}: expected standard deviations > 0.")
    precision = sigma.square().reciprocal()
    scaled = w * precision.unsqueeze(-1)
    units = Gaussian(n_visible, variance=sigma.square(), learned=_CLASSES.get(name, False)).double()
    with torch.no_grad():
        for own in (units.precision, units.first_precision):
            own.copy_(precision)  # to all digits: the constructor takes float32
    return rbm_of(scaled.mT, (ov + bv - w @ oh) * precision, bh - ov @ scaled, units)


def read_pydeep(path: str | Path) -> RBM:
    """The RBM of a ``.npz`` file with the arrays of an object of PyDeep, by their names there.

    Raises:
        UserError: The file is a pickle, as PyDeep writes them, or holds something else.
    """
    path = Path(path)
    try:
        with opened_arrays(path) as found:
            arrays = None if found.alone is not None else {name: found[name] for name in found.names}
    except ArrayFileError as error:
        raise UserError(
            f"{path} is no .npz file: PyDeep's own files are pickles, which run code when they are read. Where "
            "PyDeep is installed, load it and type numpy.savez('rbm.npz', w=rbm.w, bv=rbm.bv, bh=rbm.bh, "
            "ov=rbm.ov, oh=rbm.oh), with sigma=rbm.sigma for Gaussian units."
        ) from error
    if arrays is None:
        raise UserError(f"{path} holds one array: expected a .npz file with w, bv, bh, ov and oh.")
    return from_pydeep(arrays)
