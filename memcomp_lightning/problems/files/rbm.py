"""An RBM as numpy arrays in an ``.npz`` archive."""

import io

import numpy as np

from memcomp_lightning.array_files import ArrayFileError, opened_arrays
from memcomp_lightning.arrays import as_array
from memcomp_lightning.problems.files.objective import Objective, Parsed, RbmEnergy
from memcomp_lightning.problems.files.source import Source
from memcomp_lightning.problems.from_model import from_quadratic_form
from memcomp_lightning.problems.graph import Bipartite


def parse(source: Source, maximise: bool) -> Parsed:
    """Arrays ``weight (n_hidden, n_visible)``, ``b (n_visible,)`` and ``c (n_hidden,)``; x = (v, h)."""
    try:
        with opened_arrays(io.BytesIO(source.data)) as found:
            arrays = {name: found[name] for name in ("weight", "b", "c") if name in found.names}
            names = ", ".join(map(repr, found.names)) or "no arrays"
            if found.alone is not None:
                raise source.fault("an array alone", "an .npz archive of numpy.savez")
    except ArrayFileError as error:
        raise source.fault(f"no readable arrays ({error})", "an .npz archive of numpy.savez") from error
    if len(arrays) < 3:
        raise source.fault(names, "the arrays 'weight', 'b' and 'c'")
    for name, array in arrays.items():
        if array.dtype.kind not in "fiub" or not np.isfinite(array).all():
            raise source.fault(f"{name} of type {array.dtype} with entries that are not", "finite numbers")
    weight, b, c = (arrays[name] for name in ("weight", "b", "c"))
    if weight.ndim != 2 or 0 in weight.shape:
        raise source.fault(f"weight of shape {weight.shape}", "(n_hidden, n_visible), both >= 1")
    for name, array, size in (("b", b, weight.shape[1]), ("c", c, weight.shape[0])):
        if array.shape != (size,):
            raise source.fault(f"{name} of shape {array.shape}", f"({size},), as weight is {weight.shape}")
    double = {name: array.astype(np.float64) for name, array in arrays.items()}
    for name, array in arrays.items():
        if array.dtype.kind in "iu" and not (double[name].astype(object) == array.astype(object)).all():
            raise source.fault(
                f"{name} of type {array.dtype} with integers beyond 2^53", "numbers that float64 holds"
            )
    with np.errstate(over="ignore"):
        size = sum(float(np.abs(array).sum()) for array in double.values())
    if not np.isfinite(4 * size):
        raise source.fault("numbers whose sums are infinite in float64", "smaller ones")
    layers = Bipartite(n_first=len(b), n_second=len(c))
    bias = as_array(np.concatenate((double["b"], double["c"])))
    problem = from_quadratic_form(layers, as_array(double["weight"]), bias)
    return Parsed(problem, Objective("E(v, h)", RbmEnergy(**double)), layers.n, np.arange(layers.n))
