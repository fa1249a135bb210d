"""Workers that are not there."""

from __future__ import annotations

import pytest

from service.contract.explain import ExplainedError
from service.process.parallel import spread


@pytest.mark.parametrize("address", ["foo", "tcp://foo", "tcp://"])
def test_an_address_of_no_scheduler_is_refused_with_its_option(address: str) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(ExplainedError, match=f"--workers dask:{address}: .*needed"):
        list(spread(abs, [1], f"dask:{address}"))
