"""RBMs of scikit-learn, rbms and PyDeep here, ours there; our solvers in dimod, D-Wave's annealers here.

Where a package for it is missing, an error names it.
"""

from memcomp_lightning.interop.annealer_graph import annealer_graph
from memcomp_lightning.optional import on_demand

__all__ = [
    "MemcompSampler",
    "QpuSampler",
    "annealer_graph",
    "from_pydeep",
    "from_rbms",
    "from_scikit_learn",
    "read_pydeep",
    "read_rbms",
    "to_scikit_learn",
    "write_rbms",
]

__getattr__ = on_demand(
    __name__,
    {
        "MemcompSampler": "memcomp_sampler",
        "QpuSampler": "qpu",
        "from_pydeep": "pydeep",
        "from_rbms": "rbms",
        "from_scikit_learn": "scikit_learn",
        "read_pydeep": "pydeep",
        "read_rbms": "rbms",
        "to_scikit_learn": "scikit_learn",
        "write_rbms": "rbms",
    },
)
