"""Turns the errors of a configuration into one message for the user, without a traceback."""

import difflib
from collections.abc import Collection
from importlib.util import find_spec

from hydra.errors import HydraException, InstantiationException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException
from yaml import YAMLError

from memcomp_lightning.errors import UserError

CONFIGURATION_ERRORS = (
    UserError,
    ValueError,
    TypeError,
    OSError,
    ImportError,
    HydraException,
    OmegaConfBaseException,
    YAMLError,
)
"""What building a run may raise on account of its settings; the package's own errors are ValueErrors."""


def explain(error: BaseException) -> str:
    """Return the message for a configuration error: the innermost cause, and the setting it belongs to."""
    if isinstance(error, InstantiationException):
        setting = _full_key(*str(error).splitlines())
        cause = error.__cause__
        while cause is not None and cause.__cause__ is not None:
            cause = cause.__cause__
        text = in_words(cause) if cause is not None else str(error).splitlines()[0]
        return f"{setting}: {text}" if setting else text
    if isinstance(error, MissingConfigException) and error.options and error.missing_cfg_file:
        group, _, option = error.missing_cfg_file.rpartition("/")
        close = _nearest(option, error.options)
        hint = f" Did you mean {group}={close[0]}?" if close else ""
        plugin = group in ("hydra/launcher", "hydra/sweeper")
        remedy = " Plugins of Hydra: pip install 'memcomp-lightning[sweep]'." if plugin else ""
        return f"{group} = {option!r} does not exist.{hint} Known here: {', '.join(error.options)}.{remedy}"
    if isinstance(error, HydraException):
        text, _, _ = str(error).partition("\nConfig search path:")
        reason = "" if error.__cause__ is None else str(error.__cause__).splitlines()[0]
        return " ".join([*text.split(), reason]).rstrip()
    if isinstance(error, YAMLError):
        return f"a configuration file is no YAML: {' '.join(str(error).split())}"
    if isinstance(error, ConfigKeyError | ConfigAttributeError) and error.full_key:
        return f"setting {error.full_key} is missing: it was taken away, or a configuration file leaves it out."
    if isinstance(error, OmegaConfBaseException):
        return " ".join(str(error).split())
    setting = _full_key(*getattr(error, "__notes__", ()))  # Hydra 1.4 does not wrap what a target raises
    text = in_words(error)
    return f"{setting}: {text}" if setting else text


def in_words(error: BaseException) -> str:
    """The message of an error, in plain words where Python's own are for programmers."""
    compared, _, kinds = str(error).partition(" not supported between instances of ")
    if isinstance(error, TypeError) and compared and "'str'" in kinds:
        return "text is given where a number is expected."
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename} cannot be read or written ({error.strerror})."
    if not isinstance(error, ModuleNotFoundError) or error.name is None or "pip install" in str(error):
        return str(error)
    module, _, leaf = error.name.rpartition(".")
    if module and find_spec(module.partition(".")[0]) is not None:
        return f"{module} has no {leaf}."
    return f"no module {error.name}: install it, or put the folder that holds its file on PYTHONPATH."


def check_exists(override: str, defaults: DictConfig, groups: Collection[str]) -> None:
    """Raise if an override, ``pretrain.iteration=20``, names a setting that does not exist; say what is close.

    ``defaults`` is a composed configuration of the same groups, in which not all ``groups`` need to appear.
    """
    name, equals, _ = override.partition("=")
    if name[:1] in ("+", "~") or "@" in name or "/" in name or name.partition(".")[0] == "hydra":
        return
    if not equals:
        raise UserError(f"{override} is no setting: expected NAME=VALUE.")
    parent, _, leaf = name.rpartition(".")
    node = OmegaConf.select(defaults, parent) if parent else defaults
    if isinstance(node, DictConfig):
        if leaf in node or name in groups:
            return
        known = sorted(f"{parent}.{key!s}".lstrip(".") for key in node)
    else:
        known = sorted(str(key) for key in defaults)
    close = _nearest(name, known)
    hint = f" Did you mean {close[0]}?" if close else ""
    listed = ", ".join(known)
    raise UserError(f"setting {name} (given as {override}) does not exist.{hint} Known here: {listed}.")


def _nearest(name: str, known: Collection[str]) -> list[str]:
    """The known name that is likest, whatever the case of its letters."""
    folded = {other.lower(): other for other in known}
    return [folded[other] for other in difflib.get_close_matches(name.lower(), folded, n=1)]


def _full_key(*lines: str) -> str:
    """The setting that Hydra was building."""
    return next((line.removeprefix("full_key: ") for line in lines if line.startswith("full_key: ")), "")
