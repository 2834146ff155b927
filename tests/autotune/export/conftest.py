"""One law on one domain is found and certified once for all tests of the folder."""

from collections.abc import Iterator

import pytest

from tests.autotune.tuning.cases import OF_TARGETS, share_results


@pytest.fixture(scope="package", autouse=True)
def _shared_certificates() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        share_results(patch, OF_TARGETS)
        yield
