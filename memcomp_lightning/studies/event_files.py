"""TensorBoard's event files, which reports write where TensorBoard is installed."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

log = logging.getLogger(__name__)


@contextmanager
def event_file(folder: Path) -> Iterator["SummaryWriter | None"]:
    """Yield a writer to a folder, or None, with a word about it, where TensorBoard is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ModuleNotFoundError:
        log.warning("TensorBoard is not installed: %s gets no event file. pip install tensorboard", folder)
        yield None
        return
    with SummaryWriter(str(folder)) as writer:
        yield writer
