"""Small networks: what is tested of training does not depend on their width."""

import pytest

from drake_oa.training import networks


@pytest.fixture(scope="package", autouse=True)
def narrow_layers():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(networks, "HIDDEN", (8, 8))
        yield
