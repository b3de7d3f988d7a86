"""What Hydra 1.3 and 1.4 do differently: this package runs with both."""

from functools import partial
from typing import Any

import hydra
from hydra import utils
from omegaconf import OmegaConf

IS_1_3 = hydra.__version__.startswith("1.3.")

# 1.3 warns where `version_base` is missing, 1.4 where it is there.
INITIALIZE: dict[str, Any] = {"version_base": "1.3"} if IS_1_3 else {}
"""Arguments of Hydra's ``initialize`` functions."""

# 1.4 asks which targets a configuration may name. Samplers, solvers and data of other packages are what the groups
# are for, and what a person types or writes is trusted like code: any.
_ANY_TARGET: Any = None if IS_1_3 else utils.UNSAFE_DISABLE_EXECUTION_CHECKS  # type: ignore[attr-defined]

MAIN: dict[str, Any] = INITIALIZE if IS_1_3 else {"execution_whitelist": _ANY_TARGET}
"""Arguments of ``hydra.main``."""

instantiate = utils.instantiate if IS_1_3 else partial(utils.instantiate, _execution_whitelist_=_ANY_TARGET)

# OmegaConf 2.3, which comes with Hydra 1.3, has a `register_resolver` as well: a deprecated one of another kind.
register_resolver: Any = OmegaConf.register_new_resolver if IS_1_3 else OmegaConf.register_resolver
