"""A trained deep belief network as a generative model."""

from pathlib import Path

from memcomp_lightning.errors import UserError
from memcomp_lightning.models import DBN, GenerativeDBN
from memcomp_lightning.runs.folder import RunFolder
from memcomp_lightning.trained.alone import one_of, taken, tensors_of
from memcomp_lightning.trained.run import load


def load_generative(path: str | Path, *, pretrained: bool = False) -> GenerativeDBN:
    """Read the generative model that a run with ``updown=contrastive`` has trained.

    Args:
        path: The run folder, or its address.
        pretrained: Take the weights that up-down training began with, the same ones in both directions, without
            labels; for these the run may have been any of a DBN.

    Raises:
        UserError: The run has none.
    """
    run = load(path)
    network, where = run.network, RunFolder(run.path).weights("updown")
    if not isinstance(network, DBN):
        kind = type(network).__name__
        raise UserError(f"{path} has a {kind}, which is no deep belief network: train with model=dbn.")
    if pretrained:
        run.require_pretrained()
        return GenerativeDBN(network).eval()
    if not where.is_file():
        raise UserError(f"{path} has no generative model: train with updown=contrastive.")
    labels = (run.settings or {})["updown"]["labels"]
    model = GenerativeDBN(network, n_classes=run.needed_schema.n_classes if labels else 0)
    taken(model, one_of(tensors_of(where), model.state_dict(), run.replica, where), where)
    return model.eval()
