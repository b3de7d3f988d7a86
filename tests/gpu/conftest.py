"""The devices of these tests: CUDA where there is one, and everywhere a stand-in for it."""

from collections.abc import Iterator

import pytest
import stand_in
import torch


@pytest.fixture(params=["stand_in", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The name of a device that is not the CPU."""
    if request.param == "cuda":
        if not torch.cuda.is_available():
            pytest.skip("needs a CUDA device")
        yield "cuda"
        return
    monkeypatch.setattr(torch, "Generator", stand_in.Generator)
    with stand_in.usable():
        yield stand_in.NAME
