"""Clusters of workers that do not exist."""

from __future__ import annotations

import time

import pytest

from thirdhand.contract.explain import ExplainedError
from thirdhand.process.parallel import spread


@pytest.mark.parametrize(
    "address",
    [
        "dask:foo",
        "dask:tcp://foo",
        "dask:tcp://",
        "dask:tcp://:8786",
        "dask:127.0.0.1:99999",
        "dask:tcp://127.0.0.1:1",
    ],
)
def test_an_address_of_no_cluster_is_refused_with_its_option(address: str) -> None:
    pytest.importorskip("distributed")
    begun_s = time.monotonic()
    with pytest.raises(ExplainedError, match=f"--workers {address}: .*needed"):
        list(spread(abs, [1], address))
    assert time.monotonic() - begun_s < 30
