"""Fixture that makes networks narrow, so that tests of training are fast."""

import pytest

from drake_oa.training import networks


@pytest.fixture(scope="package", autouse=True)
def narrow_layers():
    """Replaces the hidden layers of networks by two narrow ones."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(networks, "HIDDEN", (8, 8))
        yield
